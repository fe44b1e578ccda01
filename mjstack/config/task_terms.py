"""Terms that a task, an experiment or a command line writes: where they act, and where they do not.

A group such as ``reset`` is a choice among mjstack's files and what is written over it. Gates and
trainers have copies of groups, each with a choice of its own. A term that is written over a group
acts in its copies too.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from mjstack.config.explain import own_overrides, parse
from mjstack.config.schema import EPISODES, CloneJobCfg
from mjstack.config.session import CONFIG_FOLDER

Terms = dict[str, Any]

_JUDGED = "gate.success.reset"
_OBSERVED = "observation@job.observation"
# Groups that a job leaves out, and what stands in their place
_LEFT_OUT = {
    "action": "drivers command controller.action, policies their own action",
    "termination": "task.check judges whole episodes",
    "reward": "the policy learns from an expert",
}


def complete_terms(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Put the terms that are written over ``reset`` into its copies, and a line for each term that
    does not act into ``unused_terms``, in place. The composition, of the command line's overrides,
    has Hydra's part.
    """
    choice = f"reset@{_JUDGED}"
    chosen = cfg.hydra.runtime.choices.get(choice) != "randomized"  # what the gate's file has
    chosen = chosen or any(o.startswith(f"{choice}=") for o in overrides)
    with open_dict(cfg):
        _observe_task(cfg, overrides)
        if cfg.job.name == "train" and not chosen:  # judged from starts as training has them
            terms = {name: f"${{reset.{name}}}" for name in cfg.reset}
            cfg.gate.success.reset = terms | _written(cfg, _JUDGED)
        played = [
            name
            for name in cfg.gate
            if OmegaConf.select(cfg, f"gate.{name}.func") == EPISODES
            and isinstance(terms := cfg.gate[name].get("reset"), DictConfig)
            and terms
        ]
        lines = [line for name in ("baseline", *played) for line in _complete_copy(cfg, name)]
        choices = _choices(cfg, overrides, played)
        cfg.unused_terms = [*choices, *lines, *_left_out(cfg), *_unseen(cfg)]


def _observe_task(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Let a new policy see the task's own observation, in place, where that is chosen; by default
    the state, and what the task writes beside it. Overrides of the policy's terms come on top.
    """
    choice = cfg.hydra.runtime.choices.get(_OBSERVED)
    if choice == "task":
        cfg.job.observation = OmegaConf.to_container(cfg.observation)
    elif choice == "state" and not any(o.startswith(f"{_OBSERVED}=") for o in overrides):
        group = cfg.job.group
        terms = _terms(cfg, "job.observation", group)
        known = [_content(term) for term in terms.values() if term]
        written = _written(cfg, "observation", group).items()
        terms |= {name: t for name, t in written if t and _content(t) not in known}
        cfg.job.observation[group].terms = terms
    else:
        return
    for override in map(parse, own_overrides(overrides)):
        if override.key_or_group.startswith("job.observation."):
            value = None if override.is_delete() else override.value()
            OmegaConf.update(cfg, override.key_or_group, value, force_add=True)


def _choices(cfg: DictConfig, overrides: Sequence[str], played: Sequence[str]) -> Iterator[str]:
    """A line for a choice of starts or looks on the command line that a gate with starts of its own
    has not.
    """
    choices = [override.partition("=") for override in overrides if cfg.job.name != "train"]
    missed = [
        c for c in choices if c[0] in ("reset", "looks") and c[2] not in ("starts_file", "null")
    ]
    for gate in [name for name in played if name in cfg.gates]:
        for group, _, name in missed:
            key = f"{group}@gate.{gate}.reset"
            if not any(o.lstrip("+").startswith(f"{key}=") for o in overrides):
                cure = f"{'+' * (key not in cfg.hydra.runtime.choices)}{key}={name}"
                yield f"{group}={name} does not act in gate {gate}: {cure} chooses it there"


def _complete_copy(cfg: DictConfig, gate: str) -> Iterator[str]:
    """Put the terms that are written over ``reset`` into a gate's copy of it, and yield a line for
    each that does not act there, if the gate plays episodes and runs.
    """
    key = f"gate.{gate}.reset"
    judged = gate in cfg.gates and cfg.gate[gate].func == EPISODES
    shipped = _shipped(cfg, "reset")
    copy = _terms(cfg, key)
    explicit = {*_written(cfg, key), *(name for name, term in copy.items() if term is None)}
    for name, term in _written(cfg, "reset").items():
        if copy.get(name) == f"${{reset.{name}}}":  # acts there already
            continue
        func = _func(term)
        copied = _func(copy.get(name))
        added = func != _func(shipped.get(name)) and not (copied and func.startswith("mjstack."))
        if name not in explicit and (term is None or func == copied or added):
            OmegaConf.select(cfg, key)[name] = None if term is None else f"${{reset.{name}}}"
        elif judged:
            cause = f"{key}.{name} takes its place" if copied else f"{key} has no {name}"
            yield f"reset.{name} does not act in gate {gate}: {cause}"


def _left_out(cfg: DictConfig) -> Iterator[str]:
    """A line for each group of which a job leaves out written terms."""
    job = cfg.job.name
    taught = OmegaConf.get_type(cfg.job) is CloneJobCfg
    driven = taught or job in ("gates", "collect", "play")
    where = " but gate throughput" if job == "gates" else ""
    for group, cause in _LEFT_OUT.items():
        names = [f"{group}.{name}" for name, term in _written(cfg, group).items() if term]
        if names and (taught or (driven and group != "reward")):
            yield f"job={job}{where} leaves out {', '.join(names)}: {cause}"


def _unseen(cfg: DictConfig) -> Iterator[str]:
    """A line for terms of the task's observation that a new policy does not see."""
    if "observation" not in cfg.job:
        return
    seen = _terms(cfg, "job.observation", cfg.job.group)
    seen = {name: term for name, term in seen.items() if term}
    known = [_content(term) for term in seen.values()]
    written = _written(cfg, "observation", cfg.job.group)
    if unseen := [n for n, term in written.items() if term and _content(term) not in known]:
        line = f"the policy sees {', '.join(seen)}; the task's own {', '.join(unseen)}"
        yield f"{line} it does not see ({_OBSERVED}=task has them)"


def _terms(cfg: DictConfig, key: str, group: str = "") -> Terms:
    """Terms by name, without their interpolations' values; of observations those of a group."""
    node = OmegaConf.select(cfg, f"{key}.{group}.terms" if group else key)
    return {} if node is None else OmegaConf.to_container(node, resolve=False)  # type: ignore[return-value]


def _written(cfg: DictConfig, key: str, group: str = "") -> Terms:
    """Terms that are not as the chosen file of mjstack has them; None for those left out."""
    shipped = _shipped(cfg, key, group)
    terms = _terms(cfg, key, group)
    if not shipped:  # a file of the user's, which may include one of mjstack's
        kind = key.rpartition(".")[2]
        for file in (CONFIG_FOLDER / kind).glob("*.yaml"):
            known = _file_terms(kind, file.stem, group)
            shipped |= {n: term for n, term in known.items() if terms.get(n) == term}
    names = dict.fromkeys([*shipped, *terms])
    return {n: terms.get(n) for n in names if terms.get(n) != shipped.get(n)}


def _shipped(cfg: DictConfig, key: str, group: str = "") -> Terms:
    """Terms of the chosen file of a group, if it is mjstack's; looks are reset terms."""
    kind = key.rpartition(".")[2]
    at = "" if kind == key else f"@{key}"
    files = ("reset", "looks") if kind == "reset" else (kind,)
    choices = cfg.hydra.runtime.choices
    terms: Terms = {}
    for name in files:
        terms |= _file_terms(name, choices.get(f"{name}{at}"), group)
    return terms


def _file_terms(kind: str, choice: str | None, group: str) -> Terms:
    """Terms of a file of mjstack, with those of the files that it includes."""
    file = CONFIG_FOLDER / kind / f"{choice}.yaml"
    if not file.is_file():
        return {}
    content: Terms = OmegaConf.to_container(OmegaConf.load(file), resolve=False)  # type: ignore[assignment]
    included = content.pop("defaults", [])
    terms = content.get(group, {}).get("terms", {}) if group else content
    for name in included:
        terms = _file_terms(kind, name, group) | terms
    return terms


def _content(term: Any) -> tuple[str, Any]:
    return _func(term), term.get("params", {})


def _func(term: Any) -> str:
    return str(term.get("func")) if isinstance(term, dict) else ""
