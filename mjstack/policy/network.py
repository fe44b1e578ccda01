"""The network of a policy: a multilayer perceptron between normalised observations and joint
targets.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

_CONSTANT = 1e-6  # a column that varies less has no scale
FARTHEST = 5.0  # standard deviations: an observation beyond is taken for one there


class PolicyNetwork(nn.Module):
    """Answers an observation with the joint targets of the next control steps, a chunk.

    Both are normalised inside, by mean and standard deviation, which are saved with the weights.
    """

    observation_mean: Tensor
    observation_std: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, inputs: int, joints: int, chunk: int, hidden: Sequence[int]) -> None:
        """Make the layers, with random weights of torch's generator.

        Args:
            inputs: Width of an observation.
            joints: Joint targets of one step.
            chunk: Steps of one answer.
            hidden: Widths of the hidden layers.
        """
        super().__init__()
        self.chunk = chunk
        self.joints = joints
        widths = [inputs, *hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.ELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(widths[-1], chunk * joints))
        for name, width in (("observation", inputs), ("action", joints)):
            self.register_buffer(f"{name}_mean", torch.zeros(width))
            self.register_buffer(f"{name}_std", torch.ones(width))

    def set_scale(self, name: str, mean: Tensor, std: Tensor) -> None:
        """Set how ``observation`` or ``action`` is normalised, each shape ``(width,)``. A constant
        column of an observation is only shifted; a constant joint target hardly leaves its mean.
        """
        constant = 1.0 if name == "observation" else 1e-3
        self.get_buffer(f"{name}_mean").copy_(mean)
        self.get_buffer(f"{name}_std").copy_(torch.where(std > _CONSTANT, std, constant))

    def normalized(self, observation: Tensor) -> Tensor:
        """Answer in normalised joint targets, shape ``(n, chunk, joints)``."""
        scaled = (observation - self.observation_mean) / self.observation_std
        scaled = scaled.clamp(-FARTHEST, FARTHEST)
        return self.layers(scaled).unflatten(1, (self.chunk, self.joints))

    def forward(self, observation: Tensor) -> Tensor:
        """Joint targets [rad, m].

        Args:
            observation: Shape ``(n, inputs)``.

        Returns:
            Shape ``(n, chunk, joints)``.
        """
        return self.action_mean + self.action_std * self.normalized(observation)
