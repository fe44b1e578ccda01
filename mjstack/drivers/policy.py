"""Drivers of trained policies: one observes as the policy was trained, and plays a part of each
chunk of actions before it queries the policy again; the other has a policy of LeRobot's.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import CameraCfg, Config
from mjstack.drivers.driver import Assets, Driver, require_actions
from mjstack.envs.env import Env
from mjstack.errors import ArgumentError, FolderError, TermError
from mjstack.managers import offers
from mjstack.managers.observation import ObservationManager
from mjstack.policy import Policy
from mjstack.policy.lerobot import IMAGES, SEEN, STATE
from mjstack.robots.units import LEROBOT, LerobotUnits
from mjstack.sim.cameras import Cameras, with_outputs

GRID = 2.0**20  # per unit of an action
GROUP = "policy"  # the observation group that is LeRobot's environment_state


class QueryImages:
    """Images of a policy's cameras, rendered where it is queried, whatever their rate is.

    Attributes:
        images: By name of the camera, each ``(nworld, height, width, 3)``, uint8, as of each
            world's last query.
    """

    def __init__(
        self, env: Env, cameras: Mapping[str, CameraCfg], names: Sequence[str], execute: int
    ) -> None:
        """Allocate for the cameras of these names, if any; worlds query every ``execute`` steps."""
        self._env = env
        self._execute = execute
        self.images: dict[str, Tensor] = {}
        self._cameras: Cameras | None = None
        if names:
            self._cameras = env.sim.make_cameras(with_outputs(cameras, ["rgb"], names))
            self._buffers = self._cameras.allocate()
            self.images = {name: self._buffers[f"images.{name}"] for name in names}

    def draw(self) -> None:
        """Render the worlds that query in this step."""
        due = self._env.episode_step.remainder(self._execute) == 0
        if self._cameras is not None and (due.is_cuda or bool(due.any())):
            mask = due if due.is_cuda or not bool(due.all()) else None
            self._cameras.draw(self._buffers, dict.fromkeys(self.images, mask))


@offers("driver")
class PolicyDriver(Driver):
    """Actions of a policy for every world, for an environment with the policy's action terms.

    A world queries the policy at its reset and every ``execute`` control steps from there, so
    worlds may end and start anew whenever they like. The actions of a chunk are played one after
    the other, and the last one of a shorter chunk is repeated.

    On a CPU the network computes in float64, and only if a world queries it. Actions are rounded to
    2**-20. So a world gets the same actions alone as in a batch, where sums are made in another
    order. On CUDA every step computes the network in float32, because a captured step cannot skip
    it, and worlds that do not query it keep their chunk.

    The cameras of a policy that sees images are rendered in the worlds that query it.

    Attributes:
        query_images: These images.
    """

    plays_policy = True
    noun = "policy"

    @classmethod
    @override
    def build(cls, env: Env, cfg: Config, assets: Assets) -> Driver:
        if assets.lerobot_policy:
            return LerobotDriver.with_params(cfg, env, assets.lerobot_policy, cfg)
        return cls.with_params(cfg, env, assets.policy, cfg.scene.cameras)

    def __init__(
        self, env: Env, policy: Policy, cameras: Mapping[str, CameraCfg] | None = None
    ) -> None:
        """Build the policy's observation and allocate for the environment's worlds, which have
        started; its action terms must be the policy's. ``cameras`` are the scene's, if its
        configuration does not have them. A MjstackError if the policy was trained for something
        else, or the environment takes other actions.
        """
        cfg = env.cfg
        require_actions(cfg, policy.action, "those that the policy was trained with")
        if cameras is not None:
            cfg = replace(cfg, scene=replace(cfg.scene, cameras=dict(cameras)))
        policy.check_fit(cfg)
        group = policy.group
        try:
            self._observations = ObservationManager(env, {group: policy.observation})
        except TermError as error:
            raise FolderError(
                f"policy={policy.folder}: its observation cannot be computed here: {error}"
            ) from error
        policy.check_widths(self._observations.term_dims[group], env.action_manager.action_dim)
        self._observed = self._observations.groups[group]
        self._remembers = any(term.history > 1 for term in policy.observation.terms.values())
        self._env = env
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)

        # The network, and the part of its last chunk that is played
        dtype = torch.float32 if env.device.type == "cuda" else torch.float64
        network = copy.deepcopy(policy.network).to(env.device, dtype)
        self._network = network.requires_grad_(False)
        self._dtype = dtype
        self.query_images = QueryImages(
            env, cfg.scene.cameras, list(policy.network.vision.sizes), policy.execute
        )
        self._execute = policy.execute
        shape = (env.nworld, min(policy.execute, network.chunk), network.width)
        self._chunk = torch.zeros(shape, device=env.device)
        self._action = torch.zeros_like(self._chunk[:, 0])

    def command(self) -> Tensor:
        """Actions of the next step, shape ``(nworld, action_dim)``, float32. The driver's memory:
        do not write into it.
        """
        step = self._env.episode_step
        slot = step.remainder(self._execute)
        due = slot == 0
        queries = due.is_cuda or bool(due.any())
        if self._remembers or queries:
            self._observations.compute()
        if self._remembers:
            self._observations.refresh(step == 0)
        if queries:
            self._query(due)
        played = slot.clamp(max=self._chunk.shape[1] - 1)[:, None, None]
        action = self._chunk.gather(1, played.expand(-1, 1, self._chunk.shape[2]))[:, 0]
        # A world whose state is not finite keeps its action, and the check fails it.
        self._action.copy_(torch.where(torch.isfinite(action), action, self._action))
        return self._action

    def _query(self, due: Tensor) -> None:
        """Take the policy's next chunk in the worlds where it is due, shape ``(nworld,)``, bool."""
        self.query_images.draw()
        images = [image.to(self._dtype) for image in self.query_images.images.values()]
        chunk = self._network(self._observed.to(self._dtype), images)[:, : self._chunk.shape[1]]
        chunk = (torch.round(chunk * GRID) / GRID).float()
        torch.where(due[:, None, None], chunk, self._chunk, out=self._chunk)


class LerobotWords:
    """Observations and joint targets of an environment as LeRobot has them, in its ``units``."""

    def __init__(
        self, env: Env, seen: Mapping[str, Tensor], images: Mapping[str, Tensor], units: str
    ) -> None:
        """Take what there is to see: the observation group, if any, and the cameras' images."""
        self._env = env
        self._seen = seen
        self._images = images
        self._joints = env.index.on(env.device, env.sim.qpos.dtype).qpos
        self.units = LerobotUnits(env.index.n_arm, env.index.servo_range, units)

    def observe(self) -> dict[str, np.ndarray]:
        """The observations, by LeRobot's names. A number that is not finite becomes 0: the check
        fails its world.
        """
        positions = self._joints.read(self._env.sim.qpos)
        seen = {STATE: self.units.from_si(positions.cpu().numpy())}
        for group in self._seen.values():
            seen[SEEN] = group.float().cpu().numpy()
        seen = {name: np.nan_to_num(part, posinf=0.0, neginf=0.0) for name, part in seen.items()}
        for name, image in self._images.items():
            seen[f"observation.{name}"] = image.to("cpu", copy=True).numpy()
        return seen

    def targets(self, actions: np.ndarray) -> Tensor:
        """Joint targets [rad, m], shape ``(nworld, joints)``, float32, of such actions; an
        ArgumentError if they have another width, or are radians where degrees are due.
        """
        env = self._env
        shape = (env.nworld, len(env.index.ctrl))
        if actions.shape != shape:
            expected = f"shape {shape}, a target for each joint"
            raise ArgumentError("action", f"shape {actions.shape}", expected)
        if not env.episode_step.any():
            self.units.check_commands(actions, self.observe()[STATE])
        return torch.tensor(self.units.to_si(actions), device=env.device)


class LerobotDriver(Driver):
    """Joint targets of a LeRobot policy, for worlds that begin their episodes together.

    It acts on the host, so a captured step cannot hold it. It sees the observation group ``policy``
    of the configuration without noise as ``environment_state``.
    """

    def __init__(self, env: Env, loaded: tuple[Any, Any, Any], cfg: Config) -> None:
        """Take a policy and its processors, as of `load_lerobot`; a FolderError if the scene does
        not have what they need. ``cfg`` is the configuration with its cameras and observations.
        """
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)
        self._policy, self._before, self._after = loaded
        self._task = [cfg.task.instruction or cfg.task.name] * env.nworld
        config = self._policy.config
        inputs = {name: tuple(part.shape) for name, part in config.input_features.items()}
        group = replace(cfg.observation[GROUP], noise=False)
        self._observations = ObservationManager(env, {GROUP: group} if SEEN in inputs else {})
        cameras = cfg.scene.cameras
        names = [name for name in cameras if f"{IMAGES}.{name}" in inputs]
        period = getattr(config, "n_action_steps", 1) if config.n_obs_steps == 1 else 1
        self._images = QueryImages(env, cameras, names, period)
        images = {f"images.{name}": image for name, image in self._images.images.items()}
        self._words = LerobotWords(env, self._observations.groups, images, LEROBOT)
        here = {name: part.shape[1:] for name, part in self._words.observe().items()}
        for name, shape in inputs.items():
            if here.get(name) not in (shape, (*shape[1:], *shape[:1])):  # images are (…, 3) here
                there = f"and here it is {here.get(name, 'missing')}: expected the same"
                problem = f"policy={cfg.policy}: takes {name} of shape {shape}"
                fix = "Set cameras, scene.cameras.NAME.size and observation as in its training"
                raise FolderError(f"{problem}, {there}", fix)
        self._policy.reset()

    def command(self) -> Tensor:
        """Joint targets of the next step [rad, m], shape ``(nworld, joints)``, float32."""
        self._images.draw()
        self._observations.compute()
        batch: dict[str, Any] = {"task": self._task}
        for name, part in self._words.observe().items():
            tensor = torch.from_numpy(part)
            batch[name] = tensor.permute(0, 3, 1, 2) / 255 if name.startswith(IMAGES) else tensor
        with torch.inference_mode():
            actions = self._after(self._policy.select_action(self._before(batch)))
        return self._words.targets(actions.float().cpu().numpy())
