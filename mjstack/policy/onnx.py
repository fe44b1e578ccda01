"""A policy's network in ONNX, for programs that have neither torch nor mjstack."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from mjstack.errors import MissingExtra
from mjstack.policy.network import FARTHEST, PolicyNetwork

INPUT = "observation"
OUTPUT = "action"
_OPSET = 17
_IR = 8  # runtimes since 2022 read these two


def require_onnx() -> Any:
    """The package.

    Raises:
        MissingExtra: It is not installed.
    """
    try:
        import onnx
        import onnx.helper
    except ImportError as error:
        raise MissingExtra("job=export", "onnx", "export") from error
    return onnx


def to_onnx(network: PolicyNetwork, facts: Mapping[str, Any]) -> bytes:
    """Write a network as ONNX: input ``observation``, shape ``(n, inputs)``, and output ``action``,
    shape ``(n, chunk, width)``, both float32 for any n. Each camera that it sees is one more input,
    ``images.CAMERA``, shape ``(n, height, width, 3)``, uint8.

    Args:
        network: The network; observations and actions are scaled inside, as it does itself.
        facts: Metadata by name, each written as JSON.
    """
    onnx = require_onnx()
    helper = onnx.helper
    constants: dict[str, np.ndarray] = {}
    nodes: list[Any] = []

    def add(kind: str, values: Sequence[str], *numbers: Any, **options: Any) -> str:
        """A node on earlier values and constants; returns the name of its value."""
        name = f"{kind.lower()}_{len(nodes)}"
        keys = [f"{name}_{number}" for number in range(len(numbers))]
        for key, number in zip(keys, numbers, strict=True):
            constants[key] = torch.as_tensor(number).detach().numpy()
        nodes.append(helper.make_node(kind, [*values, *keys], [name], **options))
        return name

    def add_layers(value: str, layers: nn.Module) -> str:
        for layer in layers.children():
            if isinstance(layer, nn.Linear):
                value = add("Gemm", [value], layer.weight, layer.bias, transB=1)
            elif isinstance(layer, nn.Conv2d):
                options = {"strides": layer.stride, "pads": [*layer.padding, *layer.padding]}
                value = add("Conv", [value], layer.weight, layer.bias, **options)
            elif isinstance(layer, nn.ELU):
                value = add("Elu", [value], alpha=layer.alpha)
            elif isinstance(layer, nn.Flatten):
                value = add("Flatten", [value])
            else:
                raise TypeError(f"{type(layer).__name__} has no counterpart here")
        return value

    # As PolicyNetwork.forward has it
    value = add("Sub", [INPUT], network.observation_mean)
    value = add("Div", [value], network.observation_std)
    parts = [add("Clip", [value], -FARTHEST, FARTHEST)]
    kind = onnx.TensorProto.FLOAT
    inputs = [helper.make_tensor_value_info(INPUT, kind, ["n", len(network.observation_mean)])]
    for (name, size), encoder in zip(network.vision.sizes.items(), network.encoders, strict=True):
        key = f"images.{name}"
        shape = ["n", *size, 3]
        inputs.append(helper.make_tensor_value_info(key, onnx.TensorProto.UINT8, shape))
        value = add("Transpose", [add("Cast", [key], to=kind)], perm=[0, 3, 1, 2])
        value = add("Sub", [add("Div", [value], 127.5)], 1.0)
        parts.append(add_layers(value, encoder.get_submodule("layers")))
    value = add_layers(add("Concat", parts, axis=1), network.layers)
    chunk = torch.tensor([-1, network.chunk, network.width])
    value = add("Mul", [add("Reshape", [value], chunk)], network.action_std)
    value = add("Add", [value], network.action_mean)
    add("Min", [add("Max", [value], network.action_low)], network.action_high)
    nodes[-1].output[0] = OUTPUT

    # The model around it
    graph = helper.make_graph(
        nodes,
        "policy",
        inputs,
        [helper.make_tensor_value_info(OUTPUT, kind, ["n", network.chunk, network.width])],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opset = helper.make_opsetid("", _OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR, producer_name="mjstack")
    helper.set_model_props(model, {name: json.dumps(fact) for name, fact in facts.items()})
    onnx.checker.check_model(model)
    return model.SerializeToString()
