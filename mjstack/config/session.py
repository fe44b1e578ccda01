"""Search path of the configuration, and Hydra on it.

Configuration files are found in mjstack, in installed packages that register a configuration module
under the entry point group ``mjstack.configs``, and in folders that the caller adds. The folder
beside an added one is importable, so that its YAML can name functions by module.
"""

import copy
import functools
import os
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from hydra import initialize_config_dir
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from typing_extensions import override

from mjstack.config.functions import find_object
from mjstack.errors import MjstackError
from mjstack.files import check_regular

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
# The functions that a replay calls: where a run's configuration names them, and of which kind.
_REPLAYED = {
    "controller.action.": "action term",
    "gate.success.reset.": "reset term",
    "reset.": "reset term",
    "task.check.": "check",
}

# An override that adds an entry to a mapping by names, of which the schema knows the type
_ENTRY = re.compile(
    r"\++((?:scene\.(?:objects|places|cameras)|controller\.phases|robot\.(?:placements|servos))"
    r"\.\w+(?:\.parts\.\w+)?)[.=]"
)

_added: ContextVar[tuple[Path, ...]] = ContextVar("search path", default=())


@contextmanager
def search_path(entries: Sequence[str | os.PathLike]) -> Iterator[None]:
    """Add folders to the search path of every composition inside.

    Args:
        entries: Folders, also as Hydra writes them: ``file://...``.

    Raises:
        MjstackError: There is no such folder, or it has a file of mjstack's name.
    """
    folders = [_checked_folder(str(entry)) for entry in entries]
    token = _added.set(tuple(dict.fromkeys((*_added.get(), *folders))))
    # The folder beside a configuration folder is importable.
    for folder in folders:
        if str(folder.parent) not in sys.path:
            sys.path.insert(0, str(folder.parent))
    try:
        yield
    finally:
        _added.reset(token)


def search_path_args(folders: Sequence[Path] | None = None) -> list[str]:
    """Arguments of a command that adds folders; those of the current search path if None."""
    folders = _added.get() if folders is None else folders
    return [arg for folder in folders for arg in ("--config-dir", str(folder))]


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
        Exception: It cannot be read, or has aliases: a few stand for any number of values.
    """
    check_regular(path)
    text = path.read_text()
    # libyaml, where PyYAML has it: the other parser takes minutes for brackets nested very deep.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=loader)):
        raise yaml.YAMLError("an alias")
    return OmegaConf.to_container(OmegaConf.create(text))


def config_folders() -> list[Path]:
    """Folders of the search path beside mjstack's: those of registered packages, and added ones."""
    specs = [spec for name in _registered() if (spec := find_spec(name)) is not None]
    places = [Path(place) for spec in specs for place in spec.submodule_search_locations or ()]
    return list(dict.fromkeys((*places, *_added.get())))


@functools.cache
def _registered() -> list[str]:
    """Configuration modules that installed packages register."""
    return [point.value for point in entry_points(group=ENTRY_POINTS)]


def check_replayed(cfg: DictConfig, saved: Path) -> None:
    """`check_term` for every function that a replay of a run calls.

    Args:
        cfg: The configuration of an earlier run.
        saved: Its file.
    """
    for key, name in list_items(cfg):
        for place, kind in _REPLAYED.items():
            if key.startswith(place) and key.endswith(".func"):
                check_term(key.removesuffix(".func"), str(name), kind, saved)


def check_term(label: str, dotted: str, kind: str, saved: Path) -> None:
    """Check that the folder of a policy or of a run, which may be a stranger's, may name a function
    or class: one that declares itself in an installed package (`mjstack.managers.offers`), or any
    that was defined beside a folder of the search path.

    Args:
        label: Dotted configuration key, for errors.
        dotted: Its name.
        kind: The kind of term that it is to be.
        saved: The file that names it.

    Raises:
        MjstackError: It may not.
        TermError: There is no such function.
    """
    installed = {"mjstack", *(name.partition(".")[0] for name in _registered())}
    # A module runs when it is imported, and imports others' functions too.
    if dotted.partition(".")[0] in installed or in_search_path(dotted, saved):
        func = find_object(label, dotted)
        home = str(getattr(func, "__module__", ""))
        if getattr(func, "term_kind", "") == kind or in_search_path(home, saved):
            return
    raise MjstackError(
        f"{label}.func={dotted}: expected one of the {kind}s of mjstack, of a package registered"
        f" under {ENTRY_POINTS}, or beside a folder of the search path. {add_folder(saved)}"
    )


def in_search_path(dotted: str, saved: Path) -> bool:
    """Whether a function or module lies beside a folder of the search path.

    Args:
        dotted: Its dotted name.
        saved: The file that names it. No package that it lies in counts.
    """
    package = dotted.partition(".")[0]
    try:
        module = find_spec(package)
    except ValueError:  # no name of a module, or __main__
        return False
    # A package may have several places, and a module of them may come from any. The origin of a
    # module of Python's own is a word, such as frozen.
    places = [*(module.submodule_search_locations or (module.origin or "",))] if module else []
    beside = [folder.parent for folder in _added.get()]
    files = {saved.resolve(), Path(os.path.abspath(saved))}  # it may be a link
    return bool(places) and all(
        Path(place).is_absolute()
        and Path(place).resolve().parent in beside
        and not any(
            file.is_relative_to(folder)
            for file in files
            for folder in (Path(place), Path(place).resolve())
        )
        for place in places
    )


def check_beside(key: str, file: str | None) -> None:
    """Check that an MJCF file, if a saved run names one, lies beside a folder of the search path.

    Raises:
        MjstackError: It lies elsewhere.
    """
    folders = [folder.parent for folder in config_folders()]
    if file is not None and not any(map(Path(file).is_relative_to, folders)):
        raise MjstackError(
            f"{key}={file}: expected a file beside a folder of the search path. If you trust"
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
def hydra_session() -> Iterator[Any]:
    """Hydra's application object on the current search path, also inside a Hydra application of the
    caller's, whose state comes back afterwards. It composes each list of overrides once, so that
    Hydra runs the composition that was checked.
    """
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        Plugins.instance().register(_Folders)
        Plugins.instance().register(_Folder)
        # All gates of the search path are composed, as mjstack's are.
        added = [
            n for n in list_choices()["gate"] if not (CONFIG_FOLDER / f"gate/{n}.yaml").exists()
        ]
        defaults = [{f"/gate@gate.{name}": name} for name in added]
        ConfigStore.instance().store("added_gates", {"defaults": defaults}, provider="mjstack")
        initialize_config_dir(str(CONFIG_FOLDER), "run", version_base="1.3")
        hydra: Any = GlobalHydra.instance().hydra
        _compose_once(hydra.config_loader)
        yield hydra
    finally:
        Singleton.set_state(outer)


class _Folder(FileConfigSource):
    """A folder of the search path. A file may begin with a byte order mark, which would hide its
    header from Hydra.
    """

    @staticmethod
    @override
    def scheme() -> str:
        return "mjstack"

    @override
    def load_config(self, config_path: str) -> ConfigResult:
        result = super().load_config(config_path)
        path = Path(self.path, self._normalize_file_name(config_path))
        result.header = self._get_header_dict(path.read_text("utf-8-sig"))
        return result


class _Folders(SearchPathPlugin):
    """Lets Hydra find the folders of the current search path."""

    @override
    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in config_folders():
            search_path.append(PROVIDER, f"{_Folder.scheme()}://{folder}")


def _compose_once(loader: Any) -> None:
    """Let a loader of Hydra return the composition of an earlier call with the same overrides, and
    keep in ``loader.files``, by the composition's id, the keys and values of each file behind it.
    """
    load, load_file = loader.load_configuration, loader._load_single_config
    composed: dict[tuple, DictConfig] = {}
    files: list[dict[str, object]] = []
    loader.files = {}

    def load_one_file(default: Any, repo: Any) -> ConfigResult:
        result = load_file(default, repo)
        files.append(dict(list_items(result.config)))
        return result

    def load_once(*, overrides: list[str], run_mode: RunMode, **options: Any) -> DictConfig:
        key = (*overrides, run_mode)
        if key not in composed:
            from mjstack.config.task_terms import choose_observation  # it reads CONFIG_FOLDER

            def compose(overrides: list[str]) -> DictConfig:
                files.clear()
                return load(overrides=_add_entries(overrides), run_mode=run_mode, **options)

            composed[key] = compose(choose_observation(overrides, compose))
            loader.files[id(composed[key])] = files.copy()
        return composed[key]

    loader._load_single_config = load_one_file
    loader.load_configuration = load_once


def _add_entries(overrides: Sequence[str]) -> list[str]:
    """Let the next composition end with an empty entry of the right type for each object, place,
    phase, camera or servo that a ``+`` adds: OmegaConf would take none from a command line.

    Returns:
        The overrides, which set such an entry's values over its defaults.
    """
    entries = DictConfig({})
    out = []
    for text in overrides:
        entry = _ENTRY.match(text)
        if entry:
            OmegaConf.update(entries, entry[1], {}, force_add=True)
        out.append(f"++{text.lstrip('+')}" if entry else text)
    ConfigStore.instance().store("added_entries", entries, package="_global_", provider="mjstack")
    return out


def without_hydra(cfg: DictConfig) -> DictConfig:
    """A copy of a composition without Hydra's own part."""
    rest = copy.deepcopy(cfg)
    with open_dict(rest):
        rest.pop("hydra", None)
    return rest


def list_choices() -> dict[str, list[str]]:
    """Names of every group's files in the whole search path, sorted, by group."""
    folders = (CONFIG_FOLDER, *config_folders())
    paths = [path for folder in folders for path in folder.glob("*/*.yaml")]
    choices: dict[str, list[str]] = {}
    for group, name in sorted({(path.parent.name, path.stem) for path in paths}):
        choices.setdefault(group, []).append(name)
    return choices


def _checked_folder(text: str) -> Path:
    """A folder with configuration files, absolute."""
    folder = Path(text.removeprefix(_FILE)).absolute()
    if not folder.is_dir():
        raise MjstackError(
            f"configuration folder {folder}: there is no such folder, expected one with YAML files"
            " in folders such as task/. Name an existing one."
        )
    if (folder / "conf").is_dir() and not any(folder.glob("*/*.yaml")):
        problem = f"configuration folder {folder}: has no group such as task/, and its conf may"
        raise MjstackError(problem, f"Name {folder / 'conf'}")
    for path in sorted(folder.rglob("*.yaml")):
        name = path.relative_to(folder)
        if (CONFIG_FOLDER / name).exists():
            problem = f"{path}: {name} is mjstack's own, expected a name that mjstack does not have"
            raise MjstackError(problem, "Rename the file")
    return folder.resolve()
