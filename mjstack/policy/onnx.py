"""A policy's network in ONNX, for programs that have neither torch nor mjstack."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor, nn

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
    shape ``(n, chunk, width)``, both float32 for any n.

    Args:
        network: The network; observations and actions are scaled inside, as it does itself.
        facts: Metadata by name, each written as JSON.
    """
    onnx = require_onnx()
    helper = onnx.helper
    constants: dict[str, np.ndarray] = {}
    nodes: list[Any] = []

    def add(kind: str, value: str, *numbers: Tensor | np.ndarray, **options: Any) -> str:
        """A node on the last one's value and constants; returns the name of its value."""
        name = f"{kind.lower()}_{len(nodes)}"
        inputs = [value, *(f"{name}_{number}" for number in range(len(numbers)))]
        for key, array in zip(inputs[1:], numbers, strict=True):
            constants[key] = array.numpy() if isinstance(array, Tensor) else array
        nodes.append(helper.make_node(kind, inputs, [name], **options))
        return name

    # As PolicyNetwork.forward has it
    value = add("Sub", INPUT, network.observation_mean)
    value = add("Div", value, network.observation_std)
    limits = (np.array(limit, np.float32) for limit in (-FARTHEST, FARTHEST))
    value = add("Clip", value, *limits)
    for layer in network.layers:
        if isinstance(layer, nn.Linear):
            value = add("Gemm", value, layer.weight.detach(), layer.bias.detach(), transB=1)
        elif isinstance(layer, nn.ELU):
            value = add("Elu", value, alpha=layer.alpha)
        else:
            raise TypeError(f"{type(layer).__name__} has no counterpart here")
    shape = np.array([-1, network.chunk, network.width], np.int64)
    value = add("Mul", add("Reshape", value, shape), network.action_std)
    value = add("Add", value, network.action_mean)
    add("Min", add("Max", value, network.action_low), network.action_high)
    nodes[-1].output[0] = OUTPUT

    # The model around it
    inputs = network.observation_mean.shape[0]
    kind = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(INPUT, kind, ["n", inputs])],
        [helper.make_tensor_value_info(OUTPUT, kind, ["n", network.chunk, network.width])],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opset = helper.make_opsetid("", _OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR, producer_name="mjstack")
    helper.set_model_props(model, {name: json.dumps(fact) for name, fact in facts.items()})
    onnx.checker.check_model(model)
    return model.SerializeToString()
