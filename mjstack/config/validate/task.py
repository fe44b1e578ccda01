"""Checks the scripted motion."""

from __future__ import annotations

from mjstack.config.schema import Config
from mjstack.errors import ConfigError, UnknownName


def check_controller(cfg: Config) -> None:
    """The scripted phases, and how their targets are followed."""
    _phases(cfg)
    if (
        max(cfg.controller.posture_gain, cfg.controller.approach_gain) > 0.0
        and cfg.controller.step_iterations < 4
    ):
        expected = (
            "at least 4 with a posture_gain or an approach_gain, which the last iterations make"
            " up for"
        )
        raise ConfigError("controller.step_iterations", cfg.controller.step_iterations, expected)


def _phases(cfg: Config) -> None:
    phases = cfg.controller.phases
    names = list(phases)
    sources = [*cfg.scene.objects, *cfg.scene.places]
    closed_loop = cfg.controller.name == "closed_loop" or "success" in cfg.gates
    observed = set(cfg.scene.places)
    grasped = False
    for number, (name, phase) in enumerate(phases.items()):
        key = f"controller.phases.{name}"
        for part in ("anchor", "toward"):
            source = getattr(phase, part)
            if source is None:
                continue
            if source not in sources:
                raise UnknownName(f"{key}.{part}: object or place", source, sources)
            if phase.observe:
                observed.add(source)
            elif closed_loop and source not in observed:
                expected = (
                    "true here or in a phase before, because controller=closed_loop does not know"
                    f" yet where {source} is"
                )
                raise ConfigError(f"{key}.observe", "false", expected)
        if phase.level == "on_top" and not grasped:
            raise ConfigError(
                f"{key}.level", "on_top", "center or table, as no phase before grasps"
            )
        if phase.grasps is not None and phase.grasps not in cfg.scene.objects:
            raise UnknownName(f"{key}.grasps: object", phase.grasps, cfg.scene.objects)
        grasped = grasped or phase.grasps is not None
        if phase.retry is not None and phase.retry not in phases:
            raise UnknownName(f"{key}.retry: phase", phase.retry, phases)
        if phase.retry is not None and phase.grasps is None:
            raise ConfigError(
                f"{key}.retry",
                phase.retry,
                f"null, or {key}.grasps=OBJECT, whose empty grasp is tried again",
            )
        if phase.retry is not None and names.index(phase.retry) > number:
            raise ConfigError(f"{key}.retry", phase.retry, "this phase or one before it")
        steps = phase.seconds / cfg.timing.step_dt
        if abs(steps - round(steps)) > 1e-6:
            raise ConfigError(
                f"{key}.seconds", phase.seconds, f"a multiple of the step, {cfg.timing.step_dt:g} s"
            )
    if phases and phases[names[0]].anchor is None:
        raise ConfigError("controller.phases", names[0], "a first phase with an anchor")
