"""What each rule of the box task found in one world, and what it wants: for people who look at a
replay.
"""

from __future__ import annotations

from collections.abc import Mapping

from mjstack.config.schema import Config


def report_box(cfg: Config, value: Mapping[str, float]) -> dict[str, tuple[str, str]]:
    """Every rule with numbers of its own, by name: what was found, and what it wants.

    Args:
        cfg: The configuration.
        value: What the check measured.
    """
    t = cfg.gate.box
    told: dict[str, tuple[str, str]] = {}
    for color in ("red", "blue"):
        cube = color.upper()
        ending = "" if value[f"over_box_{color}"] else ", not over the box when the hold ended"
        told |= {
            f"GRASP_{cube}": (
                f"both jaws pressed in {value[f'grasp_steps_{color}']:.0f} steps in a row",
                f"at least {t.grasp_steps} in close_{color}",
            ),
            f"LIFT_{cube}": (
                f"{value[f'lift_steps_{color}']:.0f} loaded steps in the air in a row",
                (
                    f"at least {t.lift_steps} in lift_{color} and carry_{color},"
                    f" {_mm(t.lift_height)} up, without a support"
                ),
            ),
            f"CARRY_{cube}": (
                f"{value[f'carry_{color}_m']:.3f} m loaded in the air{ending}",
                (
                    f"at least {t.carry_distance:g} m in {t.carry_steps} steps or more of"
                    f" carry_{color}, then over the box"
                ),
            ),
            f"DROP_{cube}": (
                (
                    f"{value[f'unloaded_steps_{color}']:.0f} steps without both jaws between grasp"
                    " and release"
                ),
                "none",
            ),
            f"RELEASE_{cube}": (
                f"out of the jaws at an opening of up to {100.0 * value[f'opening_{color}']:.0f} %",
                f"at least {100.0 * t.open_fraction:g} %",
            ),
            f"SETTLED_{cube}": (
                (
                    f"{value[f'settled_steps_{color}']:.0f} steps at rest in the box as"
                    f" settle_{color} ended"
                ),
                (
                    f"at least {t.window}, out of the jaws, inside within {_mm(t.inside)}, corners"
                    f" below {t.rest_speed:g} m/s"
                ),
            ),
        }
    early = "" if value["blue_too_early"] else "not "
    return told | {
        "ORDER": (f"blue was {early}grasped before red was released", "red released first"),
        "INSIDE": (
            (
                f"both at rest in the box in the last {value['rest_steps']:.0f} steps; outermost"
                f" corner {_mm(value['beyond_m'])} outside, fastest"
                f" {value['corner_speed_m_per_s']:.2g} m/s at the end"
            ),
            f"at least {t.window} steps, at most {_mm(t.inside)} outside",
        ),
        "JAW_CLEAR": (
            f"lowest jaw geometry {_mm(value['jaw_clearance_m'])} above the rim",
            f"at least {_mm(t.jaw_clearance)}",
        ),
    }


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
