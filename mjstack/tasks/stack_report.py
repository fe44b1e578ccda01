"""What each rule of the stack task found in one world's recording, and what it wants: for people
who look at a replay.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjstack.config.schema import Config


def report_stack(
    cfg: Config, steps: Mapping[str, np.ndarray], value: Mapping[str, float]
) -> dict[str, tuple[str, str]]:
    """Every rule with numbers of its own, by name: what was found, and what it wants.

    Args:
        cfg: The configuration.
        steps: What a replay keeps at step ends.
        value: What the check measured.
    """
    t = cfg.gate.acceptance
    scene = cfg.scene
    red_xy = steps["cube_pos_m"][:, 0, :2]
    blue_xy = steps["cube_pos_m"][:, 1, :2]
    airborne = steps["cube_height_m"][:, 0] > t.airborne_height
    lift = _runs(airborne, red_xy, np.isin(steps["phase"], t.lift_phases))
    carry = _runs(airborne, red_xy, steps["phase"] == t.carry_phase)
    far = max((distance for length, distance in carry if length >= t.carry_steps), default=0.0)

    window = slice(-t.window, None)
    xy = steps["xy_err_m"][window]
    dz = steps["dz_m"][window]
    gap = np.abs(steps["cube_height_m"][window, 1])
    inside = (
        np.abs(blue_xy[window] - scene.table_center[:2])
        <= np.array(scene.table_half[:2]) - scene.objects["blue"].size[0]
    ).all(1)
    return {
        "LIFT": (
            f"{max((length for length, _ in lift), default=0)} steps in the air in a row",
            f"at least {t.lift_steps} in {' and '.join(t.lift_phases)}",
        ),
        "CARRY": (
            (
                f"{far:.3f} m in {max((length for length, _ in carry), default=0)} steps in the air"
                " in a row"
            ),
            f"at least {t.carry_distance:g} m and {t.carry_steps} steps, in {t.carry_phase}",
        ),
        "STACKED": (
            f"xy_err up to {_mm(xy.max())}, dz {1e3 * dz.min():.1f} to {_mm(dz.max())}",
            (
                f"at most {_mm(t.xy_err)}, {1e3 * t.dz_min:g} to {_mm(t.dz_max)}, in the last"
                f" {t.window} steps"
            ),
        ),
        "SUPPORTED": (
            (
                f"lowest corner up to {_mm(gap.max())} off the"
                f" top{'' if inside.all() else ', centre beyond its edge'}"
            ),
            f"at most {_mm(t.support_gap)}, centre on the table",
        ),
        "REST_SPEED": (
            f"{value['rest_speed_m_per_s']:.3g} m/s RMS, peak {value['peak_speed_m_per_s']:.3g}",
            f"at most {t.rest_speed:g} m/s RMS",
        ),
        "REST_POSITION": (_mm(value["rest_position_m"]), f"at most {_mm(t.rest_position)}"),
        "REST_ROTATION": (
            f"{value['rest_rotation_deg']:.3g} deg",
            f"at most {t.rest_rotation_deg:g} deg",
        ),
    }


def _runs(airborne: np.ndarray, xy: np.ndarray, judged: np.ndarray) -> list[tuple[int, float]]:
    """Length [steps] and largest distance [m] from its own start of every uninterrupted run in the
    judged steps.
    """
    runs: list[tuple[int, float]] = []
    start: np.ndarray | None = None
    for step in np.flatnonzero(judged):
        if not airborne[step]:
            start = None
            continue
        if start is None:
            start = xy[step]
            runs.append((0, 0.0))
        length, distance = runs[-1]
        runs[-1] = length + 1, max(distance, float(np.linalg.norm(xy[step] - start)))
    return runs


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
