"""Checks the scripted motion."""

from __future__ import annotations

import math

from mjstack.config.schema import Config
from mjstack.config.validate.values import not_negative, positive, positive_int
from mjstack.errors import ConfigError, UnknownName

ANCHORS = ("red", "blue", "on_blue", "over_red", "over_blue", "red_slot", "blue_slot")


def check_controller(cfg: Config) -> None:
    """The scripted phases, and how their targets are followed."""
    names = list(cfg.controller.phases)
    watches = cfg.controller.name == "closed_loop" or "success" in cfg.gates
    looked: set[str] = set()
    for number, (name, phase) in enumerate(cfg.controller.phases.items()):
        key = f"controller.phases.{name}"
        if phase.anchor is not None and phase.anchor not in ANCHORS:
            raise UnknownName(f"{key}.anchor:", phase.anchor, ANCHORS)
        if phase.anchor in ("red_slot", "blue_slot") and getattr(cfg.scene, phase.anchor) is None:
            raise ConfigError(
                f"{key}.anchor",
                phase.anchor,
                f"an anchor of scene {cfg.scene.name}, which has no box",
            )
        if phase.gripper not in ("open", "closed"):
            raise ConfigError(f"{key}.gripper", phase.gripper, "open or closed")
        positive(f"{key}.seconds", phase.seconds, "s")
        for part in ("h_scale", "offset"):
            if not math.isfinite(getattr(phase, part)):
                raise ConfigError(f"{key}.{part}", getattr(phase, part), "a finite number")
        if phase.grasps not in (None, "red", "blue"):
            raise ConfigError(f"{key}.grasps", phase.grasps, "red, blue or null")
        if phase.retry is not None and phase.retry not in cfg.controller.phases:
            raise UnknownName(f"{key}.retry: phase", phase.retry, cfg.controller.phases)
        cube = {"on_blue": "blue", "over_red": "red", "over_blue": "blue"}.get(
            phase.anchor or "", phase.anchor
        )
        if cube in ("red", "blue"):
            if phase.look:
                looked.add(cube)
            elif watches and cube not in looked:
                expected = (
                    "true here or in a phase before, because controller=closed_loop does not know"
                    f" yet where {cube} is"
                )
                raise ConfigError(f"{key}.look", "false", expected)
        if phase.retry is not None and phase.grasps is None:
            raise ConfigError(
                f"{key}.retry",
                phase.retry,
                f"null, or {key}.grasps=red or blue, whose empty grasp is tried again",
            )
        if phase.retry is not None and names.index(phase.retry) > number:
            raise ConfigError(f"{key}.retry", phase.retry, "this phase or one before it")
        steps = phase.seconds / cfg.timing.step_dt
        if abs(steps - round(steps)) > 1e-6:
            raise ConfigError(
                f"{key}.seconds", phase.seconds, f"a multiple of the step, {cfg.timing.step_dt:g} s"
            )
    if next(iter(cfg.controller.phases.values())).anchor is None:
        raise ConfigError(
            "controller.phases", next(iter(cfg.controller.phases)), "a first phase with an anchor"
        )
    if cfg.controller.knots < 3:
        raise ConfigError("controller.knots", cfg.controller.knots, "at least 3")
    positive("controller.ik_tolerance", cfg.controller.ik_tolerance, "m")
    positive_int("controller.ik_iterations", cfg.controller.ik_iterations)
    positive_int("controller.step_iterations", cfg.controller.step_iterations)
    for key in ("posture_gain", "approach_gain", "align"):
        if not 0.0 <= getattr(cfg.controller, key) <= 1.0:
            raise ConfigError(
                f"controller.{key}", getattr(cfg.controller, key), "a share from 0 to 1"
            )
    if (
        max(cfg.controller.posture_gain, cfg.controller.approach_gain) > 0.0
        and cfg.controller.step_iterations < 4
    ):
        expected = (
            "at least 4 with a posture_gain or an approach_gain, which the last iterations make"
            " up for"
        )
        raise ConfigError("controller.step_iterations", cfg.controller.step_iterations, expected)
    not_negative("controller.rest_seconds", cfg.controller.rest_seconds, "s")
    if not (math.isfinite(cfg.controller.hurry) and cfg.controller.hurry >= 1.0):
        raise ConfigError("controller.hurry", cfg.controller.hurry, "a number of at least 1")
