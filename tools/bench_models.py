"""Time mjstack's physics step beside a bare replayed ``mujoco_warp.step`` on other people's models.

    python tools/bench_models.py --nworld 2048 humanoid/humanoid.xml aloha_pot/scene.xml mine.xml

A model that is no file is looked for in the test data of the package mujoco_warp. Actuators get
random controls over their range. A first play measures what the worlds use, as gate *capacity*
does, and the step is timed in buffers of the recommended sizes: both steps from the same state, in
turns. The last column says what became of the step: ``fused``, or why a part or all of it is
MJWarp's. ``off native`` is the largest difference of a velocity from native MuJoCo's after one step
of each from the same states.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import mujoco
import mujoco_warp
import torch
from bench_physics import bare_step
from common import count, spread

from mjstack.bench.timing import lost_worlds, timed
from mjstack.config import load_config
from mjstack.config.schema import Backend, Config
from mjstack.envs.buffers import read_peaks, recommend_sizes
from mjstack.episodes.rollout import State, restore, snapshot
from mjstack.errors import MjstackError
from mjstack.report.table import Console, Table
from mjstack.sim import BatchSizes, make_simulation, resolve_device
from mjstack.sim.mjwarp import MjwarpSimulation

MODELS = ("humanoid/humanoid.xml", "humanoid/n_humanoid.xml", "aloha_pot/scene.xml")
_SHIPPED = Path(mujoco_warp.__file__).parent / "test_data"
_DECIMATION = 10  # physics steps under one control
_SETTLE = 50  # controls before the state from which steps are timed
_COMPARED = 64  # worlds, with native MuJoCo
_GROWTHS = 4  # of the room to measure in, each by 2


def build(model: mujoco.MjModel, cfg: Config, sizes: BatchSizes) -> MjwarpSimulation:
    """Worlds of a model in buffers of these sizes."""
    sim = make_simulation(model, cfg, cfg.nworld, backend=Backend.mjwarp, sizes=sizes)
    assert isinstance(sim, MjwarpSimulation)
    return sim


def random_controls(sim: MjwarpSimulation, steps: int) -> list[torch.Tensor]:
    """Controls over the range of each actuator, from -1 to 1 where it has none."""
    limits = torch.as_tensor(sim.model.actuator_ctrlrange).float()
    limits[torch.as_tensor(sim.model.actuator_ctrllimited) == 0] = torch.tensor([-1.0, 1.0])
    low, high = limits.to(sim.device).unbind(1)
    generator = torch.Generator("cpu").manual_seed(0)
    shape = (steps, sim.nworld, len(low))
    share = torch.rand(shape, generator=generator).to(sim.device)
    return list(low + (high - low) * share)


def settle(sim: MjwarpSimulation, controls: list[torch.Tensor]) -> None:
    """Play controls from the start; worlds that are lost stay lost."""
    sim.reset()
    for ctrl in controls:
        sim.ctrl[:] = ctrl
        sim.step(_DECIMATION)


def measure(path: Path, cfg: Config, args: argparse.Namespace) -> list[str]:
    """A row of the table."""
    steps = args.steps
    model = mujoco.MjModel.from_xml_path(str(path))
    if args.implicitfast:
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    room = BatchSizes(nconmax=128, njmax=max(256, 4 * model.nv))
    for growths_left in reversed(range(_GROWTHS)):
        sim = build(model, cfg, room)
        controls = random_controls(sim, _SETTLE + steps)
        settle(sim, controls)
        peaks = read_peaks(sim)
        sim.close()
        if not peaks.overflow.any():
            break
        if not growths_left:
            raise MjstackError(f"{path.name}: buffers overflow even with {room.as_overrides()}.")
        room = BatchSizes(nconmax=2 * room.nconmax, njmax=2 * room.njmax)
    sizes = recommend_sizes(peaks, 1.25, "random controls")

    sim = build(model, cfg, sizes)
    settle(sim, controls[:_SETTLE])
    state = snapshot(sim)
    bare = bare_step(sim)

    def bare_steps() -> None:
        for _ in range(_DECIMATION):
            bare()

    works: dict[str, Callable[[], None]] = {
        "bare": bare_steps,
        "mjstack": partial(sim.step, _DECIMATION),
    }
    times: dict[str, list[float]] = {name: [] for name in works}

    def play(step: Callable[[], None]) -> None:
        for ctrl in controls[_SETTLE:]:
            sim.ctrl[:] = ctrl
            step()

    for repetition in range(args.repetitions + 1):  # the first one captures
        for name, step in works.items():
            restore(sim, state)
            seconds = timed(sim, partial(play, step))
            sim.latch()
            if repetition:
                times[name].append(1e3 * seconds / (steps * _DECIMATION))
            if lost := int(lost_worlds(sim).sum()):
                raise MjstackError(f"{path.name}: {lost} worlds were lost, so there is no figure.")
    near = State(*(rows[:_COMPARED] for rows in state))
    native = make_simulation(model, cfg, len(near.qpos), backend=Backend.native)
    off = []
    for step in (bare, partial(sim.step, 1)):
        for worlds, start in ((sim, state), (native, near)):
            restore(worlds, start)
            worlds.ctrl[:] = controls[_SETTLE][: worlds.nworld].to(worlds.ctrl)
        step()
        native.step(1)
        off.append(float((sim.qvel[:_COMPARED].cpu() - native.qvel).abs().max()))
    native.close()
    ratios = [b / a for b, a in zip(times["bare"], times["mjstack"], strict=True)]
    sim.close()
    return [
        path.name,
        f"{model.nv}, {model.ngeom}",
        f"{sizes.nconmax}, {sizes.njmax}",
        *(spread(times[name]) for name in works),
        spread(ratios),
        f"{off[0]:.1e}, {off[1]:.1e}",
        str(sim.plan),
    ]


def main() -> None:
    """Measure the models of the command line, and print a row for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="*", default=MODELS, help="MJCF files")
    parser.add_argument("--nworld", type=count, default=2048)
    parser.add_argument("--device", default="auto", help="default: %(default)s")
    parser.add_argument("--steps", type=count, default=20, help="controls per repetition")
    parser.add_argument("--repetitions", type=count, default=5)
    words = "step with the integrator that mjstack's step knows, in place of the model's"
    parser.add_argument("--implicitfast", action="store_true", help=words)
    args = parser.parse_args()
    console = Console(soft_wrap=True)
    rows = []
    failed = 0
    cfg = load_config(["sim=mjwarp", f"sim.device={args.device}", f"nworld={args.nworld}"])
    for name in args.models:
        path = Path(name) if Path(name).is_file() else _SHIPPED / name
        with console.status(f"{name}"):
            try:
                rows.append(measure(path, cfg, args))
            except (MjstackError, ValueError) as error:  # MuJoCo's own, of the file
                console.print(f"{name}: {error}")
                failed = 2
    header = [
        "model",
        "nv, geoms",
        "nconmax, njmax",
        "bare, ms per step",
        "mjstack",
        "bare over it",
    ]
    table = Table(
        title=f"{args.nworld:,} worlds, {resolve_device(cfg.sim.device)}",
        header=[*header, "off native", "step"],
        rows=rows,
    )
    console.print(table.to_console())
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
