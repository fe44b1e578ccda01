"""What each rule of the box task found in one world, and what it wants: for people who look at a replay."""

from __future__ import annotations

from collections.abc import Mapping

from mjstack.config.schema import Config


def explain_box(cfg: Config, value: Mapping[str, float]) -> dict[str, tuple[str, str]]:
    """Every rule with numbers of its own, by name: what was found, and what it wants.

    Args:
        cfg: The configuration.
        value: What the acceptance measured.
    """
    t = cfg.gate.box
    told: dict[str, tuple[str, str]] = {}
    for color in ("red", "blue"):
        cube, ending = color.upper(), "" if value[f"over_box_{color}"] else ", not over the box when the hold ended"
        told |= {
            f"GRASP_{cube}": (
                f"both jaws pressed in {value[f'grasp_frames_{color}']:.0f} frames in a row",
                f"at least {t.grasp_frames} in close_{color}",
            ),
            f"LIFT_{cube}": (
                f"{value[f'lift_frames_{color}']:.0f} loaded frames in the air in a row",
                f"at least {t.lift_frames} in lift_{color} and carry_{color}, {_mm(t.lift_height)} up, without a support",
            ),
            f"CARRY_{cube}": (
                f"{value[f'carry_{color}_m']:.3f} m loaded in the air{ending}",
                f"at least {t.carry_distance:g} m in {t.carry_frames} frames or more of carry_{color}, then over the box",
            ),
            f"DROP_{cube}": (
                f"{value[f'unloaded_frames_{color}']:.0f} frames without both jaws between grasp and release",
                "none",
            ),
            f"RELEASE_{cube}": (
                f"out of the jaws at an opening of up to {100.0 * value[f'opening_{color}']:.0f} %",
                f"at least {100.0 * t.open_fraction:g} %",
            ),
            f"SETTLED_{cube}": (
                f"{value[f'settled_frames_{color}']:.0f} frames at rest in the box as settle_{color} ended",
                f"at least {t.window}, out of the jaws, inside within {_mm(t.inside)}, corners below {t.rest_speed:g} m/s",
            ),
        }
    early = "" if value["blue_too_early"] else "not "
    return told | {
        "ORDER": (f"blue was {early}grasped before red was released", "red released first"),
        "INSIDE": (
            f"both at rest in the box in the last {value['rest_frames']:.0f} frames; outermost corner "
            f"{_mm(value['beyond_m'])} outside, fastest {value['corner_speed_m_per_s']:.2g} m/s at the end",
            f"at least {t.window} frames, at most {_mm(t.inside)} outside",
        ),
        "JAW_CLEAR": (
            f"lowest jaw geometry {_mm(value['jaw_clearance_m'])} above the rim",
            f"at least {_mm(t.jaw_clearance)}",
        ),
    }


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
