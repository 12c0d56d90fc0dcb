"""A policy's step as an ONNX graph, written node by node: matrix products, tanh and sigmoid only.

Opset 17 and IR version 8 are those of 2022: older runtimes aboard read them too. The package
`onnx` is of the extra `export`; running the file needs an ONNX runtime, and no JAX.
"""

import json
from collections.abc import Callable

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mcx_jax.errors import UserError
from mcx_jax.policy.file import Policy, named_arrays

OPSET = 17
IR_VERSION = 8


class Graph:
    """Nodes and constants so far; methods return the name of what they add."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def op(self, kind: str, *inputs: str, name: str = "", **attributes) -> str:
        """A node with one output."""
        output = name or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def split(self, x: str, names: tuple[str, ...]) -> tuple[str, ...]:
        """Equal blocks of the last axis."""
        self.nodes.append(helper.make_node("Split", [x], names, axis=-1))
        return names

    def constant(self, name: str, value: np.ndarray | float) -> str:
        """A constant, float32."""
        array = np.asarray(value, np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def affine(self, x: str, name: str, kernel: np.ndarray, bias: np.ndarray, out: str = "") -> str:
        """x @ kernel + bias."""
        product = self.op("MatMul", x, self.constant(f"{name}/kernel", kernel))
        return self.op("Add", product, self.constant(f"{name}/bias", bias), name=out)


Weights = dict[str, np.ndarray]


def lstm(graph: Graph, weights: Weights, x: str) -> str:
    """`policy.lstm` (gates input, forget, cell, output): inputs c, h; outputs c_next, h_next.

    Returns:
        The cell's output.
    """
    kernel = np.concatenate([weights["input_kernel"], weights["recurrent_kernel"]])
    together = graph.op("Concat", x, "h", axis=-1)
    pre = graph.affine(together, "cell", kernel, weights["bias"])
    i, f, g, o = graph.split(pre, ("gate_i", "gate_f", "gate_g", "gate_o"))
    kept = graph.op("Mul", graph.op("Sigmoid", f), "c")
    new = graph.op("Mul", graph.op("Sigmoid", i), graph.op("Tanh", g))
    c = graph.op("Add", kept, new, name="c_next")
    return graph.op("Mul", graph.op("Sigmoid", o), graph.op("Tanh", c), name="h_next")


def gru(graph: Graph, weights: Weights, x: str) -> str:
    """`mcx_jax.policy.gru` (gates reset, update, candidate): input h; output h_next.

    Returns:
        The cell's output.
    """
    pre = graph.affine(x, "cell", weights["input_kernel"], weights["bias"])
    kernel = graph.constant("recurrent/kernel", weights["recurrent_kernel"])
    recurrent = graph.op("MatMul", "h", kernel)
    x_r, x_z, x_n = graph.split(pre, ("x_r", "x_z", "x_n"))
    h_r, h_z, h_n = graph.split(recurrent, ("h_r", "h_z", "h_n"))
    reset = graph.op("Sigmoid", graph.op("Add", x_r, h_r))
    update = graph.op("Sigmoid", graph.op("Add", x_z, h_z))
    candidate = graph.op("Tanh", graph.op("Add", x_n, graph.op("Mul", reset, h_n)))
    kept = graph.op("Mul", update, graph.op("Sub", "h", candidate))
    return graph.op("Add", candidate, kept, name="h_next")


CELLS: dict[str, Callable[[Graph, Weights, str], str]] = {"lstm": lstm, "gru": gru}
"""How each kind of cell is written."""


def onnx_bytes(policy: Policy) -> bytes:
    """The checked ONNX model, serialised; see `mcx_jax.export` for its inputs and outputs."""
    said = policy.meta.interface
    if said["cell"] not in CELLS:
        raise UserError(f".onnx: knows no {said['cell']} cell, only {', '.join(CELLS)}; use .npz")
    graph = _step(named_arrays(policy), said)
    inputs = {"observation": policy.meta.obs_size, **said["state"]}
    outputs = {"action": policy.meta.action_size}
    outputs |= {f"{name}_next": size for name, size in said["state"].items()}
    model = helper.make_model(
        helper.make_graph(
            graph.nodes, "policy_step", _rows_of(inputs), _rows_of(outputs), graph.constants
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        producer_name="mcx_jax",
        ir_version=IR_VERSION,
    )
    helper.set_model_props(model, {"interface": json.dumps(said)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _step(arrays: Weights, said: dict) -> Graph:
    graph, normal = Graph(), said["normalisation"]
    std = np.maximum(np.sqrt(arrays["obs/var"]), np.float32(normal["std_floor"]))
    x = graph.op("Sub", "observation", graph.constant("mean", arrays["obs/mean"]))
    x = graph.op("Div", x, graph.constant("std", std))
    limits = graph.constant("low", -normal["clip"]), graph.constant("high", normal["clip"])
    x = graph.op("Clip", x, *limits)
    for name in ("dense_0", "dense_1"):
        x = graph.op("Tanh", graph.affine(x, name, *_layer(arrays, name)))
    prefix = "policy/net/cell/"
    cell = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    y = CELLS[said["cell"]](graph, cell, x)
    graph.affine(graph.op("Add", x, y), "head", *_layer(arrays, "head"), out="action")
    return graph


def _layer(arrays: Weights, name: str) -> tuple[np.ndarray, np.ndarray]:
    return arrays[f"policy/net/{name}/kernel"], arrays[f"policy/net/{name}/bias"]


def _rows_of(sizes: dict[str, int]) -> list[onnx.ValueInfoProto]:
    """float32 tensors (N, size)."""
    return [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in sizes.items()
    ]
