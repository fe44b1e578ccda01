"""Jobs: what each of them needs to know."""

from dataclasses import dataclass, field
from typing import Any

from mjstack.config.fields import MOST_SEEDS, spec


@dataclass(slots=True)
class JobCfg:
    """A job: the work of one command."""

    name: str = spec()
    """Its name."""
    func: str = spec()
    """Dotted name of its ``mjstack.jobs.Job``."""


@dataclass(slots=True)
class CollectJobCfg(JobCfg):
    """Demonstrations of the closed-loop expert, as a dataset."""

    episodes: int = spec(unit="episodes", ge=1, changes=("report",))
    """Episodes of the dataset; a call adds the missing ones."""
    keep_failures: bool = spec(changes=("episodes",))
    """Whether failed episodes are kept too, marked; they count."""
    folder: str | None = spec(None, changes=("report",))
    """Folder of the dataset; null: ``outputs/collect/<hash>`` of everything episodes depend on."""
    buffer_gib: float = spec(unit="GiB", gt=0.0, changes=("report",))
    """Device memory for the steps of one batch of worlds; more worlds are played in turns. With
    cameras also memory for images that wait for being encoded."""
    codec: str = spec("h264", choices=("h264", "av1"), changes=("episodes",))
    """Codec of the videos."""
    units: str = spec("si", choices=("si", "lerobot"), changes=("episodes",))
    """Joint values: rad and m, or LeRobot's. lerobot also gives the columns and the robot type of a
    recording of the real arm alone, so that both can be merged."""


@dataclass(slots=True)
class PlayJobCfg(JobCfg):
    """Worlds with a policy or the expert, in a viewer or as a video."""

    format: str = spec(choices=("mp4", "gif", "webp"))
    """Format of the video ``episode.<format>``; a GIF or WebP loops."""
    camera: str | None = spec(None)
    """One of ``scene.cameras``, which draws the video; null: a view from the side."""
    fps: float = spec(unit="Hz", gt=0.0)
    """Pictures per second of the video, as near as whole control steps allow."""
    width: int | None = spec(None, unit="pixels", ge=64, le=1280)
    """Width of the video; null: 640 with one world, 960 with several."""


@dataclass(slots=True)
class ExportJobCfg(JobCfg):
    """A trained policy as files of others."""

    format: str = spec()
    """onnx: policy.onnx, and the scene as model.mjb; lerobot: the folder of a LeRobot policy."""
    formats: dict[str, str] = spec()
    """Dotted names of the ``mjstack.jobs.export.Format`` that makes each."""


@dataclass(slots=True)
class TrainJobCfg(JobCfg):
    """A policy is trained, and judged from starts that training has not used."""

    trainer: str = spec()
    """Dotted name of its ``mjstack.train.trainer.Trainer``."""
    folder: str | None = spec(None, changes=("report",))
    """Folder of the training; null: ``outputs/train/<hash>`` of everything training depends on."""
    test_seed: int = spec(ge=0, le=MOST_SEEDS - 1, changes=("report",))
    """First seed of the starts from which the policy is judged, gate.success.seeds of them."""
    observation: dict[str, Any] = spec({}, finite=False)
    """Groups that the policy may see; ``observation@job.observation`` chooses them."""
    group: str = spec()
    """The group that it sees."""
    leave_out: list[str] = spec([])
    """Terms of the group that the policy does not see; NAME? if there is that one."""
    hidden: list[int] = spec(ge=1, le=65536)
    """Widths of the network's hidden layers."""
    learning_rate: float = spec(gt=0.0)
    """At the start. Of a clone a cosine brings it to 0; of PPO it stays within 0.00001 and 0.01."""


@dataclass(slots=True)
class VisionCfg:
    """Images that a policy sees, and how it learns from them."""

    cameras: list[str] = spec([])
    """Cameras of the scene that it sees; empty: none."""
    channels: list[int] = spec([32, 64, 128, 128], ge=1, le=4096)
    """Channels of the convolutions for each camera. The first one leaves a quarter of height and
    width, the others a half."""
    features: int = spec(256, ge=1, le=65536)
    """Numbers that the other layers get from each image."""
    shift: int = spec(2, unit="pixels", ge=0, le=1000)
    """Largest shift of an image in training, up, down and to the sides."""
    color: float = spec(0.2, ge=0.0, le=1.0)
    """Largest change of brightness and of each colour in training, as a share."""
    estimate: float = spec(0.0, ge=0.0)
    """Weight of the error with which it estimates the group *estimated* of its observation from the
    images, beside that of the actions."""
    pool: int | None = spec(None, unit="steps", ge=1)
    """Steps whose images the device keeps, of all rounds; null: as fit half of its free memory."""


@dataclass(slots=True)
class CloneJobCfg(TrainJobCfg):
    """A network learns to act as the expert does, from the expert's episodes and, in rounds, from
    its labels in states to which the policy has led. Sizes are those of a round.
    """

    rounds: int = spec(ge=0, le=1000)
    """Rounds after the expert's own: expert and policy drive, and the policy learns from all rounds
    so far. 0: it learns from the expert's episodes alone."""
    beta: float = spec(ge=0.0, le=1.0)
    """Share of the time in which the expert drives after the first round."""
    beta_decay: float = spec(ge=0.0, le=1.0)
    """Factor of ``beta`` from round to round."""
    spell: float = spec(unit="s", gt=0.0)
    """Time for which the expert or the policy drives before it is drawn anew."""
    wider: float = spec(ge=0.0, le=1.0)
    """Share by which the region of random starts is wider in training than in the configuration, so
    that starts at its edge have others all round."""
    length: float = spec(gt=0.0, le=1.0)
    """Share of the task's episode that is played. An expert without a clock needs less of it."""
    alone: float = spec(gt=0.0, le=1.0)
    """Share of the worlds in which the policy drives alone: their success is that of a round."""

    dataset: str | None = spec(None)
    """Folder of a dataset from which it learns; null: from the expert, who plays now."""
    source: str = spec()
    """Dotted name of the ``mjstack.train.demonstrations.Source`` that reads it."""
    chunk: int = spec(unit="steps", ge=1, le=1000)
    """Joint targets of a chunk, which is one action."""
    execute: int = spec(unit="steps", ge=1, le=1000)
    """Control steps between two queries."""
    relative: bool = False
    """Whether joint targets count from the joints as the policy observes them at its query. Then
    they depend on no joint's zero."""
    warm_up: float = spec(0.0, ge=0.0, le=1.0)
    """Share of a round's batches in which the learning rate rises to ``learning_rate``, before a
    cosine brings it to 0."""
    max_grad_norm: float | None = spec(None, gt=0.0)
    """A longer gradient, of all weights, is cut to this length; null: none is."""
    loss: str = spec(choices=("squared", "absolute"))
    """Error of a joint target. Where the expert's action jumps, an absolute error picks one of the
    two actions, and a squared error averages them."""
    episodes: int = spec(unit="episodes", ge=1)
    """Episodes that the expert plays."""
    batches: int = spec(ge=1)
    """Steps of the optimizer."""
    batch_size: int = spec(ge=1)
    """Labels of a batch."""
    save_every: int = spec(unit="batches", ge=1)
    """Batches between two saved policies."""
    input_noise: float = spec(ge=0.0)
    """Noise on the observations that training sees, in multiples of their terms' ``noise``, or of
    2 % of their standard deviation where a term has none."""
    weight_decay: float = spec(ge=0.0)
    """Of AdamW."""
    vision: VisionCfg = field(default_factory=VisionCfg)
    """Images that it sees."""


@dataclass(slots=True)
class PpoJobCfg(TrainJobCfg):
    """A policy learns from the task's rewards, by rsl_rl's PPO."""

    iterations: int | None = spec(None, ge=1, changes=("report",))
    """Iterations of the training, over all calls; null: as ``minutes`` says."""
    minutes: float | None = spec(None, unit="min", gt=0.0, changes=("report",))
    """Time of the training, over all calls; null: as ``iterations`` says."""
    max_minutes: float | None = spec(None, unit="min", gt=0.0, changes=("report",))
    """Time budget of a call; the next one goes on. null: unlimited."""
    save_every: int = spec(unit="iterations", ge=1)
    """Iterations between two saved policies."""
    expert_worlds: int = spec(unit="worlds", ge=1, le=4096)
    """reset=expert_states: worlds in which the expert plays at the beginning."""
    horizon: int = spec(unit="decisions", ge=1)
    """Decisions of every world per iteration."""
    epochs: int = spec(ge=1)
    """How often an iteration goes through them."""
    minibatches: int = spec(ge=1)
    """Parts into which they are divided."""
    gamma: float = spec(ge=0.0, le=1.0)
    """Discount per decision."""
    clip: float = spec(gt=0.0)
    """Largest change of an action's probability that counts."""
    std: float = spec(gt=0.0)
    """Standard deviation of the actions at the start."""
    desired_kl: float = spec(gt=0.0)
    """Change of the policy per iteration to which rsl_rl adapts the learning rate."""


# Trainers with keys of their own; the others have those of clone.
TRAINER_SCHEMAS = {"ppo": PpoJobCfg}
# Jobs with keys of their own; the others have `JobCfg`.
JOB_SCHEMAS = {
    "collect": CollectJobCfg,
    "play": PlayJobCfg,
    "export": ExportJobCfg,
    "train": CloneJobCfg,
}
