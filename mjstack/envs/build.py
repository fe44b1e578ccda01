"""Builds environments from a configuration."""

import os
import reprlib
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import torch

from mjstack.config import load_config
from mjstack.config.schema import Backend, Config, TermCfg
from mjstack.envs.buffers import measure_peaks, measured_sizes
from mjstack.envs.camera_schedule import without_images
from mjstack.envs.env import Env
from mjstack.errors import ArgumentError
from mjstack.managers.episode import required_fields
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import BatchSizes, make_simulation, resolve_backend, resolve_sizes


def make_env(
    overrides: Sequence[str] = (),
    *,
    nworld: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    config_dir: str | os.PathLike | None = None,
    first_world: int = 0,
) -> Env:
    """Build an environment as the command line would configure it.

    Args:
        overrides: Such as ``["task=reach", "robot=rebot", "action=ee_delta"]``.
        nworld: Number of worlds. What is given here and below wins over an override of the same
            key.
        seed: Seed of every random number.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        config_dir: A folder with more choices, such as ``push/conf`` with ``task/push.yaml``. The
            folder beside it is importable afterwards.
        first_world: Number of the first world, where other processes have the ones before. World k
            starts alike in any of them.

    Returns:
        The environment, on MJWarp where there is CUDA, else on native MuJoCo (``sim=...`` chooses).
        Call ``reset`` first.

    Raises:
        MjstackError: An override or a term cannot be used; the message says which and what to do.
    """
    several = isinstance(overrides, Sequence) and not isinstance(overrides, str)
    if not several or not all(isinstance(item, str) for item in overrides):
        expected = "a list of strings, such as ['task=reach', 'robot=rebot']"
        raise ArgumentError("overrides", reprlib.repr(overrides), expected)
    arguments = {"nworld": nworld, "seed": seed, "sim.device": device}
    more = [f"{key}={value}" for key, value in arguments.items() if value is not None]
    cfg = load_config([*overrides, *more], config_dir=config_dir)
    return build_env(cfg, first_world=first_world)


@torch.inference_mode(False)  # buffers made in inference mode could not be written outside it
def build_env(
    cfg: Config,
    *,
    nworld: int | None = None,
    model: mujoco.MjModel | None = None,
    backend: Backend | None = None,
    device: str | None = None,
    sizes: BatchSizes | None = None,
    first_world: int = 0,
) -> Env:
    """Build an environment with its simulation. Gates, whose simulation is shared, build `Env` on
    that.

    Arguments override what is configured; ``model`` is the scene, if it has been compiled before,
    and ``first_world`` as of `Env`. MJWarp's buffers have room for random actions by default. With
    ``batch=auto`` they are measured first, in worlds that are gone again before these are made.

    Raises:
        ArgumentError: The number of the first world is negative.
    """
    if first_world < 0:
        raise ArgumentError("first_world", first_world, "an integer of at least 0")
    model = model or build_model(cfg)
    nworld = nworld or cfg.nworld
    backend, device = resolve_backend(cfg, backend, device)
    if sizes is None and cfg.batch.auto and backend is Backend.mjwarp:
        peaks = measure_peaks(cfg, model, nworld, backend, device)
        sizes = measured_sizes(cfg, peaks, "random actions")
    sizes = sizes or resolve_sizes(cfg, driven=False)
    fields = required_fields(cfg.reset)
    sim = make_simulation(
        model, cfg, nworld, backend=backend, device=device, fields=fields, sizes=sizes
    )
    return Env(sim, SceneIndex(model, cfg.robot, cfg.scene), cfg, first_world=first_world)


def decided_every_step(cfg: Config) -> Config:
    """The configuration of an environment that takes an action for every control step, whatever
    the rate of a policy is.
    """
    return replace(cfg, timing=replace(cfg.timing, policy_decimation=1))


def driven_config(
    cfg: Config, reset: dict[str, TermCfg] | None = None, action: dict[str, TermCfg] | None = None
) -> Config:
    """The configuration of an environment in which a driver plays one whole episode.

    The driver's action terms take the place of the configured ones, those of an expert or a plan if
    None, and ``reset`` that of the configured reset terms. The driver acts in every control step.
    Nothing ends an episode early or rewards it: the check judges the whole. Nothing is drawn.
    """
    return replace(
        without_images(decided_every_step(cfg)),
        action=action or cfg.controller.action,
        observation={},
        termination={},
        reward={},
        task=replace(cfg.task, success=None),
        reset=cfg.reset if reset is None else reset,
    )


def demonstration_config(cfg: Config, action: dict[str, TermCfg] | None = None) -> Config:
    """The configuration of an environment whose driven episodes are kept: observations, rewards and
    success are computed as configured. Action terms as of `driven_config`.
    """
    driven = driven_config(cfg, action=action)
    return replace(driven, observation=cfg.observation, reward=cfg.reward, task=cfg.task)
