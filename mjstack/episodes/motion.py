"""Worlds in motion, for the run's 3-D page: recorded on the device, failing ones first."""

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.recorder import Channels, Read, Recorder
from mjstack.episodes.stage import Stage
from mjstack.mdp.geometry import place_xy
from mjstack.report.geometry import Fields, is_visible, match_geoms
from mjstack.report.page import World, frame_stride

_BYTES = 64 * 2**20  # of one recording


def motion_recorder(step_dt: float) -> Recorder:
    """Records the first worlds at the frames of a page, ``qpos`` of shape ``(frames, worlds, nq)``.

    ``step_dt`` is the control interval [s].
    """
    stride = frame_stride(step_dt)

    def bind(env: Env, driver: Driver) -> Read:
        qpos = env.sim.qpos
        first = qpos[: max(1, _BYTES // (len(ends(driver.steps)) * qpos[0].nbytes))]
        return lambda: {"qpos": first}

    def ends(steps: int) -> range:
        return range(0, steps + 1, stride)

    return Recorder(Channels(bind, ends))


def world_fields(stage: Stage, env: Env, worlds: Sequence[int]) -> list[Fields]:
    """Model fields of some worlds that pictures show, with the drawn places, those of the model
    with visuals.
    """
    sim = env.sim
    place_cfgs = env.cfg.scene.places.items()
    centers = {
        name: place_xy(env, name) for name, place_cfg in place_cfgs if any(place_cfg.random_xy)
    }
    fields = {name: values for name, values in sim.fields.items() if is_visible(name)}
    if not centers and not fields:
        return [{}] * len(worlds)
    visual = stage.assets.visual_model
    geoms = match_geoms(sim.model, visual)
    rows = {}
    for name, values in fields.items():
        array = values[list(worlds)].cpu().numpy()
        nominal = np.repeat(getattr(visual, name)[None], len(worlds), 0)
        if name.startswith("geom_"):  # physics has fewer of them
            nominal[:, geoms] = array
        elif array.shape == nominal.shape:  # physics may have no light
            nominal[:] = array
        rows[name] = nominal
    for name, xy in centers.items():
        nominal = np.repeat(visual.geom_pos[None], len(worlds), 0)
        disc = visual.geom(f"place/{name}").id
        rows.setdefault("geom_pos", nominal)[:, disc, :2] = xy[list(worlds)].cpu().numpy()
    return [{name: values[row] for name, values in rows.items()} for row in range(len(worlds))]


def moving_worlds(
    stage: Stage,
    env: Env,
    qpos: Tensor,
    failed: np.ndarray,
    labels: Mapping[int, str],
) -> list[World]:
    """Worlds of a batch in motion, as an episode on the stage has left them: positions that
    `motion_recorder` has recorded, bits of the task's rules, shape ``(nworld,)``, and the labels of
    the worlds that are shown, by their rows.
    """
    motions = qpos[:, [*labels]].float().swapaxes(0, 1).cpu().numpy()
    fields = world_fields(stage, env, [*labels])
    return [
        World(
            label=label,
            qpos=motion,
            rules=stage.check.rules.broken(failed[row]),
            fields=values,
        )
        for (row, label), motion, values in zip(labels.items(), motions, fields, strict=True)
    ]
