"""The driver of a trained policy: it observes as the policy was trained, and plays a part of each
chunk of actions before it queries the policy again.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import CameraCfg, Config
from mjstack.drivers.driver import Assets, Driver, require_actions
from mjstack.envs.env import Env
from mjstack.errors import FolderError, TermError
from mjstack.managers import offers
from mjstack.managers.observation import ObservationManager
from mjstack.policy import Policy
from mjstack.sim.cameras import Cameras, with_outputs

GRID = 2.0**20  # per unit of an action


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
        return cls.with_params(cfg, env, assets.policy, cfg.scene.cameras)

    @classmethod
    @override
    def trained_policy(cls, assets: Assets) -> Policy | None:
        return assets.policy

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
