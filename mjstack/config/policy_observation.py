"""The observation of a new policy: a trainer's own, or that of the task."""

from collections.abc import Callable, Sequence
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

SEEN = "observation@job.observation="
TASK_SEEN = f"{SEEN}task"


def choose_observation(
    overrides: Sequence[str], compose: Callable[[list[str]], DictConfig]
) -> list[str]:
    """Let a new policy see the task's own observation: where the overrides say so, or where they
    say nothing and the task writes all of its terms, without a choice of a file.

    Args:
        overrides: Of the command line.
        compose: Composes a configuration.

    Returns:
        The overrides with that choice, whose terms are ready for the next composition.
    """
    chosen = [o for o in overrides if o.startswith(SEEN)]
    trains = any(o.startswith(("job=train", "trainer=", "experiment=")) for o in overrides)
    if TASK_SEEN not in chosen and (chosen or not trains):
        return list(overrides)
    _store_observation({})
    # An override of one of its terms fits only where the choice has been made.
    cfg = compose([o for o in overrides if "job.observation" not in o])
    choices = cfg.hydra.runtime.choices
    alone = choices.get("observation") is None and bool(cfg.observation)
    if not (chosen or (alone and choices.get(SEEN.rstrip("=")) == "state")):
        return list(overrides)
    _store_observation(OmegaConf.to_container(cfg.observation))
    return [*(o for o in overrides if o != TASK_SEEN), TASK_SEEN]


def _store_observation(terms: Any) -> None:
    """Set what ``conf/observation/task.yaml`` includes."""
    node = OmegaConf.create(terms)
    ConfigStore.instance().store("task_observation", node, provider="mjstack")
