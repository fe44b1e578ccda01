"""A robot as a guest in a scene: what of its file comes along, and what stays behind."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

# Figures of the solver that the group `solver` leaves to the robot's file where they are null
_SOLVER = ("iterations", "ls_iterations", "impratio", "tolerance")
_FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}


def as_guest(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A fresh scene with the robot in it. Its compiler settings act on its bodies alone, and its
    options, sizes and keyframes stay behind.

    Args:
        spec: The robot; it is changed in place, and goes on to live in the scene.
    """
    fresh = mujoco.MjSpec()
    fresh.modelname = spec.modelname
    for key in list(spec.keys):
        spec.delete(key)
    if spec.compiler.settotalmass > 0.0:  # it counts all bodies of a compilation
        _fix_masses(spec)
    for name in _fields(spec.option):
        if name in _SOLVER:
            setattr(fresh.option, name, getattr(spec.option, name))
        else:
            setattr(spec.option, name, getattr(fresh.option, name))
    with _without_prefix():
        fresh.attach(spec, frame=fresh.worldbody.add_frame(), prefix="")
    return fresh


def compile_scene(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a scene with a guest."""
    with _without_prefix():
        return spec.compile()


@contextmanager
def _without_prefix() -> Iterator[None]:
    """Silence MuJoCo's warning that names without a prefix may spoil a file that is written: none
    is written.
    """
    hook = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Attaching a spec with an empty prefix")
            yield
    finally:
        mujoco.set_mju_user_warning(hook)


def left_behind(spec: mujoco.MjSpec, model: mujoco.MjModel) -> Iterator[str]:
    """What a robot's file asks for and the scene does not do, a line each.

    Args:
        spec: The file as it was read.
        model: The compiled scene.
    """
    fresh = mujoco.MjSpec().option
    for name in _fields(fresh):
        asked, default, there = (getattr(o, name) for o in (spec.option, fresh, model.opt))
        if np.array_equal(asked, default) or np.array_equal(asked, there):
            continue
        if kind := _FLAGS.get(name):
            bits = [b.name.rpartition("_")[2].lower() for b in kind if b & asked & ~there]
            if bits:
                yield f"flag {', '.join(bits)}"
            continue
        yield f"option {name} {_text(asked)}: the scene has {_text(there)}"
    if spec.keys:
        yield f"{len(spec.keys)} keyframes"


def _fields(option: object) -> list[str]:
    return [name for name in dir(option) if not name.startswith("_")]


def _text(value: object) -> str:
    return " ".join(f"{number:g}" for number in np.ravel(value))


def _fix_masses(spec: mujoco.MjSpec) -> None:
    """Give bodies the masses and inertias that they have when the robot is compiled alone."""
    alone = spec.copy()
    alone.compiler.fusestatic = False  # the same bodies
    model = alone.compile()
    for body, twin in zip(spec.bodies[1:], alone.bodies[1:], strict=True):
        body.explicitinertial = True
        body.mass = model.body_mass[twin.id]
        for name in ("inertia", "ipos", "iquat"):
            setattr(body, name, getattr(model, f"body_{name}")[twin.id])
    spec.compiler.settotalmass = -1.0
