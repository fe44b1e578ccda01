"""The driver that asks a trained policy: it observes as the policy was trained, and plays a part of
each answer before it asks again.
"""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mjstack.config.schema import CameraCfg
from mjstack.drivers.driver import Driver, require_joint_targets
from mjstack.envs.env import Env
from mjstack.errors import PolicyError, TermError
from mjstack.managers.action import ActionManager
from mjstack.managers.observation import ObservationManager
from mjstack.mdp.geometry import robot
from mjstack.policy import Policy
from mjstack.sim.cameras import Cameras, color_cameras

_GRID = 2.0**20  # per rad or m


class PolicyDriver(Driver):
    """Joint targets of a policy for every world.

    A world asks at its reset and every ``execute`` control steps from there, so worlds may end and
    start anew whenever they like.

    On a CPU the network computes in float64, and only if a world asks. Targets are rounded to
    2**-20 rad or m. So a world gets the same targets alone as in a batch, where sums are made in
    another order. On CUDA every step computes the network in float32, because a captured step
    cannot skip it, and worlds that do not ask keep their targets.

    A policy that sees images has its cameras drawn in the worlds that ask, when they ask.

    A policy with other actions than absolute joint targets brings its action terms. They turn each
    action, which is repeated until the next answer, into joint targets in every control step.
    """

    def __init__(
        self, env: Env, policy: Policy, cameras: Mapping[str, CameraCfg] | None = None
    ) -> None:
        """Build the policy's observation and allocate for the environment's worlds.

        Args:
            env: The environment, its worlds started; its action terms must take absolute joint
                targets.
            policy: The policy.
            cameras: The scene's cameras, if the environment's configuration does not have them.

        Raises:
            MjstackError: The policy was trained for something else, or the environment takes other
                actions.
        """
        cfg = env.cfg
        require_joint_targets(cfg, "absolute joint targets, which a policy gives")
        if cameras is not None:
            cfg = replace(cfg, scene=replace(cfg.scene, cameras=dict(cameras)))
        policy.check_fit(cfg)
        group = policy.group
        try:
            # Its own action terms write the joint targets
            self._actions = ActionManager(env, policy.action) if policy.action else None
            view = env if self._actions is None else _OwnActions(env, self._actions)
            self._observations = ObservationManager(view, {group: policy.observation})
        except TermError as error:
            raise PolicyError(
                f"policy={policy.folder}: its observation or action cannot be computed here:"
                f" {error}"
            ) from error
        width = len(cfg.robot.joints) if self._actions is None else self._actions.action_dim
        policy.check_widths(self._observations.term_dims[group], width)
        self._observed = self._observations.groups[group]
        self._remembers = any(term.history > 1 for term in policy.observation.terms.values())
        self._env = env
        super().__init__(env.nworld, cfg.task.episode_steps, env.device)

        # The network, and the part of its last answer that is played
        dtype = torch.float32 if env.device.type == "cuda" else torch.float64
        network = copy.deepcopy(policy.network).to(env.device, dtype)
        self._network = network.requires_grad_(False)
        self._dtype = dtype
        self._cameras: Cameras | None = None
        self._images: dict[str, Tensor] = {}
        names = list(policy.network.vision.sizes)
        if names:
            # They are drawn when the policy asks, whatever their rate is.
            self._cameras = env.sim.make_cameras(color_cameras(cfg.scene.cameras, names))
            self._images = self._cameras.allocate()
        self._execute = policy.execute
        shape = (env.nworld, min(policy.execute, network.chunk), network.joints)
        self._chunk = torch.zeros(shape, device=env.device)
        self._ctrl = robot(env).ctrl
        self._command = self._ctrl.read(env.sim.ctrl).float().clone()

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``, float32. The driver's own memory:
        do not write into it.
        """
        step = self._env.episode_step
        if self._actions is not None:
            self._actions.reset(step == 0)
        slot = step.remainder(self._execute)
        asks = slot == 0
        asking = asks.is_cuda or bool(asks.any())
        if self._remembers or asking:
            self._observations.compute()
        if self._remembers:
            self._observations.refresh(step == 0)
        if asking:
            self._ask(asks)
        played = slot.clamp(max=self._chunk.shape[1] - 1)[:, None, None]
        target = self._chunk.gather(1, played.expand(-1, 1, self._chunk.shape[2]))[:, 0]
        if self._actions is not None:
            target = self._apply(self._actions, target)
        # A world whose state is not finite keeps its targets, and the check fails it.
        self._command.copy_(torch.where(torch.isfinite(target), target, self._command))
        return self._command

    def _apply(self, actions: ActionManager, action: Tensor) -> Tensor:
        """Joint targets that the policy's action terms write. The environment writes the same ones
        again.
        """
        actions.process(torch.nan_to_num(action, 0.0, 0.0, 0.0))
        actions.apply()
        return self._ctrl.read(self._env.sim.ctrl).float()

    def _ask(self, asks: Tensor) -> None:
        """Take the policy's answer in the worlds that ask, shape ``(nworld,)``, bool."""
        if self._cameras is not None:
            mask = asks if asks.is_cuda or not bool(asks.all()) else None
            self._cameras.draw(self._images, dict.fromkeys(self._cameras.cameras, mask))
        images = [image.to(self._dtype) for image in self._images.values()]
        answer = self._network(self._observed.to(self._dtype), images)[:, : self._chunk.shape[1]]
        answer = (torch.round(answer * _GRID) / _GRID).float()
        torch.where(asks[:, None, None], answer, self._chunk, out=self._chunk)


class _OwnActions:
    """The environment as a policy's terms see it: the actions are the policy's."""

    def __init__(self, env: Env, actions: ActionManager) -> None:
        self._env = env
        self.action = actions.action
        self.previous_action = actions.previous_action

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)
