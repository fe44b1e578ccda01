"""Search path of the configuration, and Hydra on it.

Configuration files are found in mjstack, in installed packages that register a configuration module
under the entry point group ``mjstack.configs``, and in folders that the caller adds. The folder
beside an added one is importable, so that its YAML can name functions by module.
"""

import codecs
import copy
import functools
import os
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
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
from mjstack.files import CONFIG_FOLDER, yaml_text

CONFIG_NAME = "config"
ENTRY_POINTS = "mjstack.configs"
PROVIDER = "mjstack.search_path"  # of added entries, in a run's .hydra/hydra.yaml

# An override that adds an entry to a mapping by names, of which the schema knows the type
_ENTRY = re.compile(
    r"\++((?:scene\.(?:objects|places|cameras)|controller\.phases|robot\.(?:placements|servos))"
    r"\.\w+(?:\.(?:parts|joints)\.\w+)?)[.=]"
)

_added: ContextVar[tuple[Path, ...]] = ContextVar("search path", default=())


@contextmanager
def search_path(entries: Sequence[str | os.PathLike]) -> Iterator[None]:
    """Add folders, also as Hydra writes them, ``file://...``, to the search path of every
    composition inside; a MjstackError if there is none, or it has a file of mjstack's name.
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


def add_folder(saved: Path, *more: Path) -> str:
    """The advice where the search path lacks a folder that the run of a config.yaml had used, or
    ``more``, where it lacks none of these.
    """
    folders = [folder for folder in used_folders(saved) if folder not in config_folders()]
    args = shlex.join(search_path_args(folders or more)) or "--config-dir DIR"
    return f"If you trust the folder that it used, add {args}."


def used_folders(saved: Path) -> list[Path]:
    """Folders that the run of a config.yaml had added to its search path, as far as it says."""
    try:
        return added_folders(read_yaml(saved.with_name("hydra.yaml"))["hydra"]["runtime"])
    except Exception:  # the file may be missing, or hold anything
        return []


def added_folders(runtime: Any) -> list[Path]:
    """Folders that were added to the search path of a composition, from ``hydra.runtime``."""
    return [Path(s["path"]) for s in runtime["config_sources"] if s["provider"] == PROVIDER]


def read_yaml(path: Path) -> Any:
    """Read YAML of a run's folder, which may be a stranger's: interpolations stay text. Any
    exception says that it cannot be read, as of `yaml_text`.
    """
    return OmegaConf.to_container(OmegaConf.create(yaml_text(path)))


def config_folders() -> list[Path]:
    """Folders of the search path beside mjstack's: those of registered packages, and added ones."""
    specs = [spec for name in _registered() if (spec := find_spec(name)) is not None]
    locations = [
        Path(location) for spec in specs for location in spec.submodule_search_locations or ()
    ]
    return list(dict.fromkeys((*locations, *_added.get())))


@functools.cache
def _registered() -> list[str]:
    """Configuration modules that installed packages register."""
    return [point.value for point in entry_points(group=ENTRY_POINTS)]


def check_term(label: str, dotted: str, kind: str, saved: Path) -> None:
    """Check that the folder of a policy or of a run, which may be a stranger's, may name a function
    or class: one that declares itself as a kind of term in an installed package
    (`mjstack.managers.offers`), or any that was defined beside a folder of the search path. The
    label is its configuration key, and ``saved`` the file that names it. A MjstackError if it may
    not, a TermError if there is no such function.
    """
    installed = {"mjstack", *(name.partition(".")[0] for name in _registered())}
    # A module runs when it is imported, and imports others' functions too.
    if dotted.partition(".")[0] in installed or in_search_path(dotted, saved):
        func = find_object(label, dotted)
        home = str(getattr(func, "__module__", ""))
        if getattr(func, "term_kind", "") == kind or in_search_path(home, saved):
            return
    raise MjstackError(
        f"{label}.func={dotted}: expected one of the {kind}s of mjstack, a registered package or"
        f" the search path. {add_folder(saved)}"
    )


def in_search_path(dotted: str, saved: Path) -> bool:
    """Whether a function or module, by its dotted name, lies beside a folder of the search path. No
    package counts in which the file lies that names it, ``saved``.
    """
    package = dotted.partition(".")[0]
    try:
        module = find_spec(package)
    except ValueError:  # no name of a module, or __main__
        return False
    # A package may have several places, and a module of them may come from any. The origin of a
    # module of Python's own is a word, such as frozen.
    locations = [*(module.submodule_search_locations or (module.origin or "",))] if module else []
    parents = [folder.parent for folder in _added.get()]
    files = {saved.resolve(), Path(os.path.abspath(saved))}  # it may be a link
    return bool(locations) and all(
        Path(location).is_absolute()
        and Path(location).resolve().parent in parents
        and not any(
            file.is_relative_to(folder)
            for file in files
            for folder in (Path(location), Path(location).resolve())
        )
        for location in locations
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


class _Folders(SearchPathPlugin):
    """Lets Hydra find the folders of the current search path."""

    @override
    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in config_folders():
            provider = PROVIDER if folder in _added.get() else f"{PROVIDER}.registered"
            search_path.append(provider, f"file://{folder}")


def _compose_once(loader: Any) -> None:
    """Let a loader of Hydra return the composition of an earlier call with the same overrides, and
    keep in ``loader.files``, by the composition's id, the folder, keys and values of each file
    behind it.
    """
    load, load_file = loader.load_configuration, loader._load_single_config
    composed: dict[tuple, DictConfig] = {}
    files: list[tuple[Path, dict[str, object]]] = []
    loader.files = {}

    def load_one_file(default: Any, repo: Any) -> ConfigResult:
        result = load_file(default, repo)
        path = Path(str(result.path).partition("://")[2], default.config_path)
        files.append((path.parent, dict(list_items(result.config))))
        return result

    def load_once(*, overrides: list[str], run_mode: RunMode, **options: Any) -> DictConfig:
        key = (*overrides, run_mode)
        if key not in composed:
            files.clear()
            composed[key] = load(overrides=_add_entries(overrides), run_mode=run_mode, **options)
            loader.files[id(composed[key])] = files.copy()
        return composed[key]

    loader._load_single_config = load_one_file
    loader.load_configuration = load_once


def _add_entries(overrides: Sequence[str]) -> list[str]:
    """Let the next composition end with an empty entry of the right type for each object, place,
    phase, camera or servo that a ``+`` adds: OmegaConf would take none from a command line. The
    overrides come back, and set such an entry's values over its defaults.
    """
    entries = DictConfig({})
    rewritten = []
    for text in overrides:
        entry = _ENTRY.match(text)
        if entry:
            OmegaConf.update(entries, entry[1], {}, force_add=True)
        rewritten.append(f"++{text.lstrip('+')}" if entry else text)
    ConfigStore.instance().store("added_entries", entries, package="_global_", provider="mjstack")
    return rewritten


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
    folder = Path(text.removeprefix("file://")).absolute()
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
        if path.read_bytes().startswith(codecs.BOM_UTF8):  # it hides the file's header
            raise MjstackError(f"{path}: begins with a byte order mark", "Save it without")
    return folder.resolve()
