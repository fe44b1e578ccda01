"""The network of a policy: a multilayer perceptron between normalised observations and actions,
and convolutions between images and it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn

_CONSTANT = 1e-6  # a column that varies less has no scale
_UNBOUNDED = torch.finfo(torch.float32).max
_FARTHEST = 5.0  # standard deviations: an observation beyond is taken for one there


@dataclass(frozen=True, kw_only=True)
class Vision:
    """Images that a policy sees, and the layers that read them.

    Attributes:
        sizes: Height and width of each camera's images, by its name.
        channels: Channels of each convolution. The first one leaves a quarter of height and width,
            each other one a half.
        features: Numbers that the perceptron gets from each image.
    """

    sizes: Mapping[str, Sequence[int]] = field(default_factory=dict)
    channels: Sequence[int] = ()
    features: int = 0


class ImageEncoder(nn.Module):
    """Convolutions that turn images into some numbers each."""

    def __init__(self, size: Sequence[int], channels: Sequence[int], features: int) -> None:
        """Make the layers for images of a size, height and width."""
        super().__init__()
        layers: list[nn.Module] = []
        height, width = size
        for before, after in pairwise([3, *channels]):
            # Most of the time goes into the largest images, so the first convolution leaves less.
            kernel, stride = (3, 2) if layers else (7, 4)
            layers += [nn.Conv2d(before, after, kernel, stride, kernel // 2), nn.ELU()]
            height = -(-height // stride)
            width = -(-width // stride)
        flat = channels[-1] * height * width
        self.layers = nn.Sequential(*layers, nn.Flatten(), nn.Linear(flat, features), nn.ELU())

    def forward(self, images: Tensor) -> Tensor:
        """Shape ``(n, features)`` from images of shape ``(n, height, width, 3)``, 0 to 255."""
        return self.layers(images.permute(0, 3, 1, 2) / 127.5 - 1.0)


class PolicyNetwork(nn.Module):
    """Maps an observation to the actions of the next control steps, a chunk.

    Both are normalised inside, by mean and standard deviation, which are saved with the weights. So
    is a range that no action leaves.

    Attributes:
        chunk: Actions of one query.
        width: Numbers of one action.
        hidden: Widths of the hidden layers.
        vision: Images that it sees; without cameras if there are none.
        relative: Columns of an observation with the measured joints, to which actions are added;
            none where actions are absolute.
    """

    origin: Tensor
    observation_mean: Tensor
    observation_std: Tensor
    action_mean: Tensor
    action_std: Tensor
    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        inputs: int,
        width: int,
        chunk: int,
        hidden: Sequence[int],
        vision: Vision | None = None,
        relative: Sequence[int] = (),
    ) -> None:
        """Make the layers, with random weights of torch's generator. ``inputs`` is the width of an
        observation without its images; the rest are the attributes.
        """
        super().__init__()
        self.chunk = chunk
        self.width = width
        self.hidden = list(hidden)
        self.vision = vision = vision or Vision()
        self.relative = list(relative)
        if self.relative:  # that the observed joints count from
            self.register_buffer("origin", torch.zeros(width))
        self.encoders = nn.ModuleList(
            ImageEncoder(size, vision.channels, vision.features) for size in vision.sizes.values()
        )
        widths = [inputs + vision.features * len(vision.sizes), *hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.ELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(widths[-1], chunk * width))
        for name, size in (("observation", inputs), ("action", width)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("action_low", torch.full((width,), -_UNBOUNDED))
        self.register_buffer("action_high", torch.full((width,), _UNBOUNDED))

    def set_scale(self, name: str, mean: Tensor, std: Tensor) -> None:
        """Set how ``observation`` or ``action`` is normalised, each shape ``(width,)``. A constant
        column of an observation is only shifted; a constant action hardly leaves its mean.
        """
        constant = 1.0 if name == "observation" else 1e-3
        self.get_buffer(f"{name}_mean").copy_(mean)
        self.get_buffer(f"{name}_std").copy_(torch.where(std > _CONSTANT, std, constant))

    def set_range(self, low: Tensor, high: Tensor) -> None:
        """Set the range that actions are kept in, each shape ``(width,)``."""
        self.action_low.copy_(low)
        self.action_high.copy_(high)

    def encode(self, images: Sequence[Tensor]) -> list[Tensor]:
        """Features of each camera's images, each ``(n, features)``."""
        return [encode(image) for encode, image in zip(self.encoders, images, strict=True)]

    def normalized(self, observation: Tensor, features: Sequence[Tensor] = ()) -> Tensor:
        """Normalised actions, ``(n, chunk, width)``, from observation and image features."""
        scaled = (observation - self.observation_mean) / self.observation_std
        scaled = scaled.clamp(-_FARTHEST, _FARTHEST)
        scaled = torch.cat([scaled, *(part.to(scaled.dtype) for part in features)], dim=1)
        return self.layers(scaled).unflatten(1, (self.chunk, self.width))

    def measured(self, observation: Tensor) -> Tensor | float:
        """The joints that actions are added to, ``(n, 1, width)``; 0 where they are absolute."""
        if not self.relative:
            return 0.0
        columns = [observation[:, column] for column in self.relative]
        return (torch.stack(columns, dim=1) + self.origin)[:, None]

    def forward(self, observation: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Actions, ``(n, chunk, width)``, in the units of the policy's action terms, from an
        observation, ``(n, inputs)``, and the images of each camera of ``vision``, ``(n, height,
        width, 3)``, 0 to 255, in the network's type.
        """
        normalized = self.normalized(observation, self.encode(images))
        actions = self.action_mean + self.action_std * normalized + self.measured(observation)
        return torch.minimum(torch.maximum(actions, self.action_low), self.action_high)
