"""Composes `conf/` into the dataclasses of `schema`."""

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from mjstack.config import session
from mjstack.config.check import validate
from mjstack.config.complete import complete
from mjstack.config.explain import check_added, check_overrides, explain, own_overrides, parse
from mjstack.config.fingerprint import POLICY_FILE, policy_folder
from mjstack.config.schema import JOB_SCHEMAS, TRAINER_SCHEMAS, Backend, Config
from mjstack.config.task_terms import complete_terms
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import read_json, reading

_schema = OmegaConf.structured(Config)
_schema.gate._set_flag("struct", False)  # gates of the search path are added to it
ConfigStore.instance().store(name="mjstack_schema", node=_schema, provider="mjstack")
for _name, _node in (JOB_SCHEMAS | TRAINER_SCHEMAS).items():
    ConfigStore.instance().store(name=f"{_name}_schema", node=_node, provider="mjstack")


def _control_steps(seconds: float | None, *, _root_: DictConfig) -> int:
    """Control steps of a time [s], which ``${steps:SECONDS}`` stands for; null: of all phases."""
    if seconds is None:
        seconds = sum(phase.seconds for phase in _root_.controller.phases.values())
    step_dt = _root_.timing.physics_dt * _root_.timing.decimation
    return round(seconds / step_dt) if step_dt > 0.0 else 1  # what is wrong is told later


def _by_device(cuda: Any, cpu: Any, *, _root_: DictConfig) -> Any:
    """The value for the device of the run, which ``${by_device:CUDA,CPU}`` stands for."""
    device = _root_.sim.device
    if _root_.sim.backend == Backend.native:
        device = "cpu"
    elif device == "auto":
        from torch.cuda import is_available  # takes a second

        device = "cuda" if is_available() else "cpu"
    return cuda if device.startswith("cuda") else cpu


def _ranged(values: Any, middle: float = 0.0, *, _root_: DictConfig) -> Any:
    """The ends of a range, or its half-width, as far from the middle as ``range_scale`` says."""
    if isinstance(values, Sequence):
        return [_ranged(value, middle, _root_=_root_) for value in values]
    return middle + _root_.range_scale * (values - middle)


# The functions that a replay calls: where a run's configuration names them, and of which kind.
_REPLAYED = {
    r"controller\.func": "driver",
    r"controller\.action\.": "action term",
    r"(?s)(gate\..+\.)?reset\.": "reset term",  # a gate's name may hold anything
    r"task\.check\.": "check",
}

# Interpolations: ${NAME:ARGUMENT,...} is the value of a function of these and of the configuration.
_RESOLVERS: dict[str, Callable] = {
    "steps": _control_steps,
    "by_device": _by_device,
    "if_native": lambda a, b, *, _root_: a if _root_.sim.backend == Backend.native else b,
    "ranged": _ranged,
    "at_most": lambda value, limit, small, large: small if value <= limit else large,
}
for _name, _function in _RESOLVERS.items():
    OmegaConf.register_new_resolver(_name, _function)


def load_config(
    overrides: Sequence[str] = (), *, config_dir: str | os.PathLike | None = None
) -> Config:
    """Compose the configuration as the command line does.

    Args:
        overrides: Command-line overrides, such as ``["robot=rebot", "nworld=64"]``.
        config_dir: A folder with more choices, such as ``push/conf`` with ``task/push.yaml``. The
            folder beside it is importable afterwards.

    Returns:
        The configuration, complete and validated.

    Raises:
        MjstackError: An override does not fit; the message says which and what would.
    """
    with configured(overrides, config_dir) as cfg:
        return cfg


@contextmanager
def configured(overrides: Sequence[str], config_dir: str | os.PathLike | None) -> Iterator[Config]:
    """The configuration of `load_config`, whose search path goes on inside: a policy that is loaded
    there may name functions beside it.
    """
    folders = [] if config_dir is None else [config_dir]
    with extended_search_path(overrides, folders) as composed:
        with session.hydra_session():
            cfg = to_config(compose(composed))
        yield cfg


@contextmanager
def extended_search_path(
    overrides: Sequence[str], folders: Sequence[str | os.PathLike]
) -> Iterator[list[str]]:
    """Add folders, and those of overrides of ``hydra.searchpath``, to the search path of every
    composition inside. Yields the other overrides, and what the policy that they name was trained
    for.
    """
    entries = list(map(str, folders))
    remaining = [o for o in overrides if not o.lstrip("+").startswith("hydra.searchpath=")]
    for override in [override for override in overrides if override not in remaining]:
        value = parse(override).value()
        entries += map(str, value if isinstance(value, list) else [value])
    with session.search_path(entries):
        yield [*remaining, *_policy_choices(remaining)]


def _policy_choices(overrides: Sequence[str]) -> list[str]:
    """Robot, task and cameras of the policy that the overrides name, where they choose none; none
    of a policy that cannot be read, which a check says later.
    """
    keys = {override.partition("=")[0] for override in overrides}
    named = [parse(override).value() for override in overrides if override.startswith("policy=")]
    folder = named[0] if len(named) == 1 and "experiment" not in keys else None
    if not isinstance(folder, str):
        return []
    try:
        policy_json = read_json(policy_folder(folder) / POLICY_FILE)
        trained = {group: [policy_json["config"][group]["name"]] for group in ("robot", "task")}
        trained["cameras"] = list(policy_json["observation"].get("images", {}))
    except Exception:  # it may hold anything
        return []
    choices = session.list_choices()
    return [
        f"{group}={names[0] if len(names) == 1 else names}".replace("'", "").replace(" ", "")
        for group, names in trained.items()
        if group not in keys and names and all(name in choices[group] for name in names)
    ]


def compose(overrides: Sequence[str], run_mode: RunMode = RunMode.RUN) -> DictConfig:
    """Compose in a `hydra_session` without validating values; Hydra's part is in it, and errors are
    one line each.
    """
    if run_mode is RunMode.RUN:
        check_overrides(overrides)
    loader: Any = GlobalHydra.instance().config_loader()
    try:
        cfg = loader.load_configuration(
            config_name=session.CONFIG_NAME, overrides=list(overrides), run_mode=run_mode
        )
        if run_mode is RunMode.RUN:
            check_added(session.without_hydra(cfg), overrides)
            files = [*loader.files[id(cfg)], (Path(), _set_values(overrides))]
            _locate_files(cfg, files)
            _keep_exact(cfg, [values for _, values in files])
            complete_terms(cfg, overrides)
    except (HydraException, OmegaConfBaseException, AssertionError, TypeError, ValueError) as error:
        raise explain(error, overrides) from error
    except YAMLError as error:
        raise MjstackError(f"{' '.join(str(error).split())}.") from error
    return cfg


def _set_values(overrides: Sequence[str]) -> dict[str, object]:
    """Keys and values of overrides."""
    typed: dict[str, object] = {}
    for override in map(parse, own_overrides(overrides)):
        value: Any = None if override.is_delete() else override.value()
        typed |= {override.key_or_group: value}
        typed |= dict(session.list_items(value, f"{override.key_or_group}."))
    return typed


def _locate_files(cfg: DictConfig, files: Sequence[tuple[Path, Mapping[str, object]]]) -> None:
    """Make the paths of MJCF files absolute: each is relative to the YAML that names it last, or,
    where an override does, to the working folder. ``files`` are the folder, keys and values of
    each, in the order of composition.
    """
    named = [(owner, owner._get_node("file")._dereference_node()) for _, owner in _with_file(cfg)]
    # All before the first changes, as one may take another's value
    sources = [(owner, node._get_full_key(None), node._value()) for owner, node in named]
    for owner, source, value in sources:
        folders = [folder for folder, values in files if source in values]
        owner.file = os.path.abspath(Path(*folders[-1:], value))


def _with_file(cfg: DictConfig) -> Iterator[tuple[str, Any]]:
    """The robot and the objects that have an MJCF file, by their keys."""
    objects = OmegaConf.select(cfg, "scene.objects", default={})
    for key in ("robot", *(f"scene.objects.{name}" for name in objects)):
        owner = OmegaConf.select(cfg, key)
        if isinstance(OmegaConf.select(cfg, f"{key}.file"), str):
            yield key, owner


def _keep_exact(cfg: DictConfig, files: Sequence[Mapping[str, object]]) -> None:
    """Joint targets of closed jaws that replace the robot's own are for any object, unless a width
    comes with them or after them. ``files`` are the keys and values of each, in the order of
    composition.
    """
    closed, width = "robot.gripper_closed", "robot.closed_width"
    settings = [source for source in files if source.keys() & {closed, width}]
    targets = [number for number, source in enumerate(settings) if closed in source]
    if targets and targets[-1] > 0 and not any(width in s for s in settings[targets[-1] :]):
        cfg.robot.closed_width = None


def load_saved(path: Path) -> Config:
    """The configuration that a run left in ``.hydra/config.yaml``, typed and checked as a new one
    is; a MjstackError if the file cannot be read, is no configuration of this version, or names
    functions or a robot that are not in the search path.
    """
    with reading(path, "Name another folder"):
        plain = session.read_yaml(path)
        if "${" in str(plain):
            raise ValueError("it has ${...}")
        merged = cast(DictConfig, OmegaConf.merge(_schema, plain))
        if missing := sorted(OmegaConf.missing_keys(merged)):
            raise MjstackError(f"{missing[0]} is missing, expected every key of this version.")
        for key, name in session.list_items(merged):
            for pattern, kind in _REPLAYED.items():
                if re.match(pattern, key) and key.endswith(".func"):
                    session.check_term(key.removesuffix(".func"), str(name), kind, path)
        _locate_saved(merged, path)
        try:
            cfg = to_config(merged)
        except ConfigError as error:
            if not error.key.endswith(".file"):
                raise
            raise MjstackError(f"{error} {session.add_folder(path)}") from error
    return cfg


def _locate_saved(cfg: DictConfig, path: Path) -> None:
    """Let the MJCF files of a run, which may be a stranger's, be beside the folders of the search
    path, wherever these are by now; a MjstackError if one is not.
    """
    folders = session.config_folders()
    used = session.used_folders(path)
    moved = zip(
        [folder for folder in used if folder not in folders],
        [folder for folder in folders if folder not in used],
        strict=False,
    )
    pairs = [(folder.parent, folder.parent) for folder in folders]
    pairs += [(old.parent, new.parent) for old, new in moved]
    for key, owner in _with_file(cfg):
        file = Path(os.path.abspath(owner.file))
        candidates = [new / file.relative_to(old) for old, new in pairs if file.is_relative_to(old)]
        if not candidates:
            problem = f"{key}.file={file}: expected a file beside a folder of the search path"
            raise MjstackError(f"{problem}. {session.add_folder(path, file.parent)}")
        owner.file = str(candidates[0])


def to_config(cfg: DictConfig) -> Config:
    """Turn a composed configuration into dataclasses and check their values."""
    try:
        config = cast(Config, OmegaConf.to_object(session.without_hydra(cfg)))
    except (OmegaConfBaseException, AttributeError, TypeError) as error:
        raise explain(error) from error
    complete(config)
    validate(config)
    return config
