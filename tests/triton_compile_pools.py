"""As triton_compile.py, the pools' kernels.

python tests/triton_compile_pools.py [--full]
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator
from typing import Any

import torch

from surfconv_ops.triton.avg_pool import BY_WEIGHT, avg_backward_kernel, avg_forward_kernel
from surfconv_ops.triton.layer import Layer
from surfconv_ops.triton.max_pool import max_backward_kernel, max_forward_kernel
from surfconv_ops.triton.pool_tiles import pool_tiles
from triton_compile import POINTERS, compiled, usage

KERNELS = {"max_forward": max_forward_kernel, "max_backward": max_backward_kernel,
           "avg_forward": avg_forward_kernel, "avg_backward": avg_backward_kernel}  # fmt: skip


def layer(channels: int, dtype: torch.dtype, axes: int) -> Layer:
    return Layer(batch=8, channels=channels, size=(240, 320), kernel=(3, 3), stride=(2, 2),
                 padding=(1, 1), dilation=(1, 1), output=(120, 160), axes=axes,
                 dtype=dtype)  # fmt: skip


def jobs(full: bool) -> Iterator[tuple[str, Layer, dict[str, Any]]]:
    """Kernel, layer, and what else it is compiled for."""
    layers = [layer(64, torch.bfloat16, 1)]
    if full:
        layers += [layer(64, torch.float32, 2), layer(64, torch.float16, 1),
                   layer(32, torch.float64, 1), layer(3, torch.float32, 1)]  # fmt: skip
    for kernel in KERNELS:
        for one in layers:
            for guide in (False, True) if full else (True,):
                exact = 2 if one.dtype == torch.float64 else 1
                for words in (0, exact) if full and "backward" in kernel else (0,):
                    yield kernel, one, {"guide": guide, "words": words}


def specification(kernel: str, one: Layer, options: dict[str, Any], cut: Any) -> dict[str, Any]:
    """Types of the kernel's arguments by name; a value where it is a constant."""
    data = POINTERS[one.dtype]
    total = POINTERS[one.compute_dtype]
    words = options["words"]
    limits = total if options["guide"] else None
    return {
        "output_ptr": data, "input_ptr": data, "grad_output_ptr": data, "winner_ptr": "*u8",
        "scale_ptr": total, "guide_ptr": limits, "tolerance_ptr": limits, "partial_ptr": total,
        "sums_ptr": "*i64" if words else total, "factors_ptr": "*fp64" if words else None,
        "NEED_INPUT": True, "NEED_SCALE": True, "WORDS": words, "DIVISOR": BY_WEIGHT.value,
        **one.constants(), **cut.constants(),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="every tile size and more layers")
    full = parser.parse_args().full
    for capability in (80, 90) if full else (90,):
        for kernel, one, options in jobs(full):
            for cut in pool_tiles(one, "backward" in kernel)[: None if full else 1]:
                given = specification(kernel, one, options, cut)
                result = compiled(KERNELS[kernel], given, capability)
                ptx = result.asm["ptx"]
                print(json.dumps({
                    "kernel": kernel, "sm": capability, "dtype": str(one.dtype),
                    "channels": one.channels, **options,
                    "tiles": [cut.pixels, cut.channels, cut.warps],
                    "wide_loads": len(re.findall(r"ld\.global\.v[24]", ptx)),
                    "shared": result.metadata.shared, **usage(result.asm["cubin"]),
                }), flush=True)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
