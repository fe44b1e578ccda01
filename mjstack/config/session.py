"""Search path of the configuration, and Hydra on it.

Configuration files are found in mjstack, in installed packages that register a configuration module
under the entry point group ``mjstack.configs``, and in folders that the caller adds. The folder
beside an added one is importable, so that its YAML can name functions by module.
"""

import copy
import functools
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import yaml  # type: ignore[import-untyped]
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.singleton import Singleton
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from hydra.version import setbase
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader

from mjstack.config.functions import find_object
from mjstack.errors import CompositionError

_PACKAGE_FOLDER = Path(__file__).parents[1]
# In a checkout the configuration lies beside the package, in a wheel inside of it.
CONFIG_FOLDER = next(
    folder
    for folder in (_PACKAGE_FOLDER.parent / "conf", _PACKAGE_FOLDER / "conf")
    if (folder / "config.yaml").is_file()
)
CONFIG_NAME = "config"
ENTRY_POINTS = "mjstack.configs"
PROVIDER = "mjstack.search_path"  # of added entries, in a run's .hydra/hydra.yaml
_FILE = "file://"
# Where a replay's functions are named.
_REPLAYED = ("controller.action.", "gate.success.reset.", "reset.", "task.check.")

_added: ContextVar[tuple[Path, ...]] = ContextVar("search path", default=())


@contextmanager
def search_path(entries: Sequence[str | os.PathLike]) -> Iterator[None]:
    """Add folders to the search path of every composition inside.

    Args:
        entries: Folders, also as Hydra writes them: ``file://...``.

    Raises:
        CompositionError: There is no such folder, or it has a file of mjstack's name.
    """
    found = [_checked_folder(str(entry)) for entry in entries]
    token = _added.set(tuple(dict.fromkeys((*_added.get(), *found))))
    # The folder beside a configuration folder is importable.
    for folder in found:
        if str(folder.parent) not in sys.path:
            sys.path.insert(0, str(folder.parent))
    try:
        yield
    finally:
        _added.reset(token)


def search_path_args(folders: Sequence[Path] | None = None) -> list[str]:
    """Arguments of a command that adds folders; those of the current search path if None."""
    folders = _added.get() if folders is None else folders
    if len(folders) < 2:
        return [arg for folder in folders for arg in ("--config-dir", str(folder))]
    return [f"hydra.searchpath=[{','.join(map(quoted, folders))}]"]


def quoted(path: Path) -> str:
    """A path as a value of an override."""
    text = str(path).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{text}'"


def add_folder(saved: Path) -> str:
    """The advice where the search path lacks a folder that a run had used.

    Args:
        saved: The run's ``config.yaml``.
    """
    try:
        sources = read_yaml(saved.with_name("hydra.yaml"))["hydra"]["runtime"]["config_sources"]
        folders = lacking_folders(sources)
    except Exception:  # the file may be missing, or hold anything
        folders = []
    flag = shlex.join(search_path_args(folders)) or "--config-dir DIR"
    return f"If you trust the folder that the run had used, add {flag}."


def lacking_folders(sources: Iterable[Any]) -> list[Path]:
    """Added folders among Hydra's sources of a composition that the current search path lacks."""
    used = [Path(source["path"]) for source in sources if source["provider"] == PROVIDER]
    return [folder for folder in used if folder not in config_folders()]


def read_yaml(path: Path) -> Any:
    """Read YAML of a run's folder, which may be a stranger's: interpolations stay text.

    Raises:
        Exception: It cannot be read.
    """
    return yaml.load(path.read_text(), _Reader)


def config_folders() -> list[Path]:
    """Folders of the search path beside mjstack's: those of registered packages, and added ones."""
    specs = [spec for name in _registered() if (spec := find_spec(name)) is not None]
    places = [Path(place) for spec in specs for place in spec.submodule_search_locations or ()]
    return list(dict.fromkeys((*places, *_added.get())))


@functools.cache
def _registered() -> list[str]:
    """Configuration modules that installed packages register."""
    return [point.value for point in entry_points(group=ENTRY_POINTS)]


def check_trusted(cfg: DictConfig, saved: Path) -> None:
    """Check that every function that a replay uses is in the current search path, and that it was
    defined there: a module imports others' functions too.

    Args:
        cfg: The configuration of an earlier run.
        saved: Its file.

    Raises:
        CompositionError: A function is elsewhere; names it.
        TermError: There is no such function.
    """
    for key, name in list_items(cfg):
        if not (key.startswith(_REPLAYED) and key.endswith(".func")):
            continue
        if not is_trusted_function(key.removesuffix(".func"), str(name), saved):
            raise CompositionError(
                f"{key}={name}: expected a name of mjstack, of a package registered under"
                f" {ENTRY_POINTS}, or beside a folder of the search path. {add_folder(saved)}"
            )


def is_trusted_function(label: str, dotted: str, saved: Path) -> bool:
    """Whether a saved file may name a function, and the function was defined in a trusted module
    too; arguments as of `is_trusted`, and the key that names it.

    Raises:
        TermError: There is no such function.
    """
    # A module runs when it is imported.
    return is_trusted(dotted, saved) and is_trusted(
        str(getattr(find_object(label, dotted), "__module__", "")), saved
    )


def is_trusted(dotted: str, saved: Path) -> bool:
    """Whether a saved run may name a function or module: one of mjstack, of a registered package,
    or of the search path.

    Args:
        dotted: Its dotted name.
        saved: The run's ``config.yaml``. No package that it lies in is trusted.
    """
    package = dotted.partition(".")[0]
    if package in {"mjstack", *(name.partition(".")[0] for name in _registered())}:
        return True
    try:
        found = find_spec(package)
    except ValueError:  # no name of a module, or __main__
        return False
    # A package may have several places, and a module of them may come from any. The origin of a
    # module of Python's own is a word, such as frozen.
    places = [*(found.submodule_search_locations or (found.origin or "",))] if found else []
    beside = [folder.parent for folder in _added.get()]
    own = {saved.resolve(), Path(os.path.abspath(saved))}  # it may be a link
    return bool(places) and all(
        Path(place).is_absolute()
        and Path(place).resolve().parent in beside
        and not any(
            file.is_relative_to(folder)
            for file in own
            for folder in (Path(place), Path(place).resolve())
        )
        for place in places
    )


def check_beside(file: str | None) -> None:
    """Check that a robot's file, if a saved run names one, lies beside a folder of the search path.

    Raises:
        CompositionError: It lies elsewhere.
    """
    folders = [folder.parent for folder in config_folders()]
    if file is not None and not any(map(Path(file).is_relative_to, folders)):
        raise CompositionError(
            f"robot.file={file}: expected a file beside a folder of the search path. If you trust"
            f" it, add {shlex.join(search_path_args([Path(file).parent]))}."
        )


def list_items(node: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Every dotted key of a composition, in OmegaConf's types or plain, and its value."""
    if isinstance(node, DictConfig):
        node = OmegaConf.to_container(node, resolve=False)
    for name, value in node.items() if isinstance(node, dict) else ():
        yield f"{prefix}{name}", value
        yield from list_items(value, f"{prefix}{name}.")


@contextmanager
def hydra_session() -> Iterator[Hydra]:
    """A Hydra on the current search path, also inside a Hydra application of the caller's, whose
    state comes back afterwards.
    """
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        setbase("1.3")
        path = create_config_search_path(f"{_FILE}{CONFIG_FOLDER}")
        path.get_path().pop()  # the schema, which Hydra wants last
        for folder in config_folders():
            path.append(PROVIDER, f"{_FILE}{folder}")
        path.append("schema", "structured://")
        hydra = Hydra(task_name="run", config_loader=_Loader(path))
        GlobalHydra.instance().initialize(hydra)
        yield hydra
    finally:
        Singleton.set_state(outer)


def compose_raw(overrides: Sequence[str]) -> DictConfig:
    """Compose on the current search path, with Hydra's own errors."""
    with hydra_session() as hydra:
        cfg = hydra.compose_config(CONFIG_NAME, list(overrides), RunMode.RUN, from_shell=False)
    return without_hydra(cfg)


def without_hydra(cfg: DictConfig) -> DictConfig:
    """A composition without Hydra's own part. It shares the others."""
    own = DictConfig({})
    shared = {name: cfg._get_node(name) for name in cfg if name != "hydra"}
    vars(own).update(vars(cfg) | {"_content": shared})
    return own


def list_choices() -> dict[str, list[str]]:
    """Names of every group's files in the whole search path, sorted, by group."""
    folders = (CONFIG_FOLDER, *config_folders())
    paths = [path for folder in folders for path in folder.glob("*/*.yaml")]
    choices: dict[str, list[str]] = {}
    for group, name in sorted({(path.parent.name, path.stem) for path in paths}):
        choices.setdefault(group, []).append(name)
    return choices


class _Repository(ConfigRepository):
    """Parses a file once in a process, which is a quarter of the time of a composition."""

    _parsed: ClassVar[dict[tuple, ConfigResult | None]] = {}

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load a file, or return what an earlier composition loaded, as long as it is unchanged."""
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or source.scheme() == "structured":
            return super().load_config(config_path)
        file = Path(source.path, f"{config_path.removesuffix('.yaml')}.yaml")
        changed = file.stat().st_mtime_ns if source.scheme() == "file" else 0
        key = (source.provider, file, changed)
        if key not in self._parsed:
            self._parsed[key] = super().load_config(config_path)
        return self._parsed[key]


class _Reader(get_yaml_loader()):  # type: ignore[misc]
    """Reads YAML as OmegaConf does, but no aliases: a few stand for any number of values."""

    def fetch_alias(self) -> None:
        """Refuse an alias."""
        raise yaml.YAMLError("an alias")


class _Loader(ConfigLoaderImpl):
    """Composes each list of overrides once: Hydra then runs the composition that was checked."""

    _merged: ClassVar[dict[str, DictConfig]] = {}

    def __init__(self, config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self.repository = _Repository(config_search_path)
        self._composed: dict[tuple, DictConfig] = {}

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose, or return the composition of an earlier call."""
        key = (config_name, *overrides, run_mode)
        if key not in self._composed:
            # All gates of the search path are composed, as mjstack's are.
            own = {path.stem for path in CONFIG_FOLDER.glob("gate/*.yaml")}
            names = {p.stem for folder in config_folders() for p in folder.glob("gate/*.yaml")}
            gates = [f"+gate@gate.{name}={name}" for name in sorted(names - own)]
            cfg = super().load_configuration(
                config_name, [*gates, *overrides], run_mode, from_shell, validate_sweep_overrides
            )
            said = cfg.hydra.overrides.task
            cfg.hydra.overrides.task = [override for override in said if override not in gates]
            self._composed[key] = cfg
        return self._composed[key]

    def _compose_config_from_defaults_list(self, defaults: list, repo: Any) -> DictConfig:
        """Merge files, or copy what an earlier composition merged of the same content."""
        key = str([(default, repo.load_config(default.config_path)) for default in defaults])
        if key not in self._merged:
            repo.cache = copy.deepcopy(repo.cache)  # the composition takes its nodes over
            self._merged[key] = super()._compose_config_from_defaults_list(defaults, repo)
        merged = copy.deepcopy(self._merged[key])
        OmegaConf.clear_cache(merged)  # of ${now:...}
        return merged


def _checked_folder(text: str) -> Path:
    """A folder with configuration files, absolute."""
    folder = Path(text.removeprefix(_FILE)).absolute()
    if text.startswith("pkg://"):
        raise CompositionError(
            f"hydra.searchpath: found {text}, expected a folder, such as file://DIR. An installed"
            f" package registers its folder as an entry point of {ENTRY_POINTS}."
        )
    if not folder.is_dir():
        raise CompositionError(
            f"configuration folder {folder}: there is no such folder, expected one with YAML files"
            " in folders such as task/. Name an existing one."
        )
    if (folder / "conf").is_dir() and not any(folder.glob("*/*.yaml")):
        raise CompositionError(
            f"configuration folder {folder}: has no group such as task/, and its folder conf may."
            f" Name {folder / 'conf'}."
        )
    for path in sorted(folder.rglob("*.yaml")):
        name = path.relative_to(folder)
        if (CONFIG_FOLDER / name).exists():
            raise CompositionError(
                f"{path}: {name} is mjstack's own, expected a name that mjstack does not have."
                " Rename the file."
            )
    return folder.resolve()
