"""Compiles every kernel of the CUDA backend for GPUs that need not be here, and prints what came.

    python tests/triton_compile.py [--full]

One line of JSON per kernel: registers, bytes spilled, tensor core instructions. A kernel that
Triton or ptxas refuses ends the program.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from surfconv_ops.triton import conv, tiles
from surfconv_ops.triton.backward_data import backward_data_kernel
from surfconv_ops.triton.backward_weight import backward_weight_kernel
from surfconv_ops.triton.forward import forward_kernel

POINTERS = {torch.float32: "*fp32", torch.float64: "*fp64", torch.float16: "*fp16",
            torch.bfloat16: "*bf16"}  # fmt: skip
FORWARD = ("output_ptr", "input_ptr", "weight_ptr", "bias_ptr")


def layer(
    channels: int, dtype: torch.dtype, groups: int = 1, kernel: int = 3, axes: int = 1
) -> Any:
    return conv.Conv(batch=8, channels=channels, size=(240, 320), kernel=(kernel, kernel),
                     stride=(1, 1), padding=(kernel // 2,) * 2, dilation=(1, 1),
                     output=(240, 320), axes=axes, dtype=dtype, out_channels=channels,
                     groups=groups)  # fmt: skip


def jobs(full: bool) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Kernel, layer, and what else it is compiled for."""
    half = (torch.bfloat16, torch.float16) if full else (torch.bfloat16,)
    layers = [layer(64, dtype) for dtype in (*half, torch.float32)]
    layers.append(layer(96, torch.float32, groups=96, kernel=7, axes=2))
    if full:
        layers += [layer(32, torch.float64), layer(512, torch.bfloat16), layer(512, torch.float32),
                   layer(64, torch.float32, groups=32)]  # fmt: skip
    for one in layers:
        single = one.dtype == torch.float32
        for tf32, guide in product((False, True) if single and one.groups == 1 else (False,),
                                   (False, True) if full else (one.axes == 2,)):  # fmt: skip
            options = {"guide": guide, "tf32": tf32}
            yield "forward", one, options
            for adds in (True, False) if full else (True,):
                yield "backward_weight", one, options | {"adds": adds}
            exact = 2 if one.dtype == torch.float64 else 1
            for words in (0, exact) if full else (0,):
                yield "backward_data", one, options | {"words": words}


def specification(kernel: str, one: Any, options: dict[str, Any], cut: Any) -> dict[str, Any]:
    """Types of the kernel's arguments by name; a value where it is a constant."""
    data = POINTERS[one.dtype]
    total = "*fp64" if one.dtype == torch.float64 else "*fp32"
    types: dict[str, Any] = {"scale_ptr": total, "guide_ptr": None, "tolerance_ptr": None}
    if options["guide"]:
        types |= {"guide_ptr": total, "tolerance_ptr": total}
    constants = one.constants() | cut.constants()
    if kernel == "forward":
        types |= dict.fromkeys(FORWARD, data)
        constants["UNROLL"] = cut.unrolled
    if kernel == "backward_data":
        words = options["words"]
        sums, factors = ("*i64", "*fp64") if words else (total, None)
        types |= {"sums_ptr": sums, "factors_ptr": factors, "partial_ptr": total,
                  "weight_ptr": data}  # fmt: skip
        constants |= {"NEED_INPUT": True, "NEED_SCALE": True, "WORDS": words}
    if kernel == "backward_weight":
        # Written in place or added to sums.
        types |= {"sums_ptr": total if options["adds"] else data}
        constants["ADDS"] = options["adds"]
    return {"input_ptr": data, "grad_output_ptr": data} | types | constants


KERNELS = {"forward": forward_kernel, "backward_data": backward_data_kernel,
           "backward_weight": backward_weight_kernel}  # fmt: skip
CUTS = {"forward": tiles.forward_tiles, "backward_data": tiles.data_tiles,
        "backward_weight": tiles.weight_tiles}  # fmt: skip


def compiled(function: Any, given: dict[str, Any], capability: int) -> Any:
    signature: dict[str, str] = {}
    constants: dict[str, Any] = {}
    aligned: dict[tuple[int, ...], list[list[Any]]] = {}
    for place, name in enumerate(function.arg_names):
        value = given.get(name, "i32")
        if isinstance(value, str) and not name.isupper():
            signature[name] = value
            if value.startswith("*") or name in ("channels", "out_channels", "group_channels",
                                                 "group_out"):  # fmt: skip
                aligned[(place,)] = [["tt.divisibility", 16]]
        else:
            signature[name] = "constexpr"
            constants[name] = value
    source = ASTSource(function, signature, constants, aligned)
    options = {"num_warps": given["num_warps"], "num_stages": given["num_stages"]}
    return triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)


def usage(cubin: bytes) -> dict[str, int]:
    """Registers, and bytes of stack they are spilled to, by the tool that comes with Triton."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    if not tool.is_file():
        return {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.cubin"
        path.write_bytes(cubin)
        done = subprocess.run(
            [tool, "-res-usage", path], capture_output=True, text=True, check=True
        )
    found = dict(re.findall(r"(REG|STACK):(\d+)", done.stdout + done.stderr))
    return {name.lower(): int(value) for name, value in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="every tile size and more layers")
    full = parser.parse_args().full
    for capability in (80, 86, 90) if full else (86, 90):
        for kernel, one, options in jobs(full):
            torch.backends.cuda.matmul.allow_tf32 = options["tf32"]
            for cut in CUTS[kernel](one)[: None if full else 1]:
                given = specification(kernel, one, options, cut)
                result = compiled(KERNELS[kernel], given, capability)
                ptx = result.asm["ptx"]
                print(json.dumps({
                    "kernel": kernel, "sm": capability, "dtype": str(one.dtype),
                    "channels": one.channels, "groups": one.groups, **options,
                    "tiles": [cut.pixels, cut.channels_in, cut.channels_out, cut.warps],
                    "mma": len(re.findall(r"\b(?:wgmma\.mma_async|mma\.sync)", ptx)),
                    "wide_loads": len(re.findall(r"ld\.global\.v[24]", ptx)),
                    "shared": result.metadata.shared, **usage(result.asm["cubin"]),
                }), flush=True)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
