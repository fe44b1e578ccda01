"""A policy's network in ONNX, for programs that have neither torch nor mjstack."""

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from mjstack.errors import MissingExtra
from mjstack.policy.network import PolicyNetwork

INPUT = "observation"
OUTPUT = "action"
_OPSET = 17  # runtimes since 2022 read it


def require_onnx() -> Any:
    """The package; a MissingExtra where it is not installed."""
    try:
        import onnx
    except ImportError as error:
        raise MissingExtra("job=export", "onnx", "export") from error
    return onnx


def to_onnx(network: PolicyNetwork, facts: Mapping[str, Any]) -> bytes:
    """Write a network as ONNX: input ``observation``, shape ``(n, inputs)``, and output ``action``,
    shape ``(n, chunk, width)``, both float32 for any n. Each camera that it sees is one more input,
    ``images.CAMERA``, shape ``(n, height, width, 3)``, uint8. Observations and actions are scaled
    inside, as the network does itself. The facts are its metadata by name, each written as JSON.
    """
    onnx = require_onnx()
    images = {
        f"images.{name}": torch.zeros((1, *size, 3), dtype=torch.uint8)
        for name, size in network.vision.sizes.items()
    }
    inputs = [INPUT, *images]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        torch.onnx.export(
            network,
            (torch.zeros(1, len(network.observation_mean)), [*images.values()]),
            path,
            input_names=inputs,
            output_names=[OUTPUT],
            dynamic_axes={name: {0: "n"} for name in [*inputs, OUTPUT]},
            opset_version=_OPSET,
            dynamo=False,  # torch's newer exporter needs onnxscript, and ten times as long
        )
        model = onnx.load(path)
    onnx.helper.set_model_props(model, {name: json.dumps(fact) for name, fact in facts.items()})
    onnx.checker.check_model(model)
    return model.SerializeToString()
