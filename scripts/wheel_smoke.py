"""Checks an installed surfconv_ops: the compiled operator is there, and it computes and trains."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
import torch.nn.functional as F

import surfconv_ops


def main() -> None:
    folder = Path(surfconv_ops.__file__).parent
    assert "site-packages" in folder.parts, f"{folder} is not an installed package"
    assert shutil.which("g++") is None, "a compiler is on PATH: this would prove nothing"
    capability = torch.ops.surfconv.cpu_capability()

    torch.manual_seed(0)
    x = torch.randn(2, 4, 12, 16, requires_grad=True)
    conv = torch.nn.Conv2d(4, 8, 3, padding=1)
    surf = surfconv_ops.SurfConv2d.from_conv2d(conv, reference_depth=2.0)
    depth = torch.full((2, 12, 16), 2.0)

    out = surf(x, depth)
    torch.testing.assert_close(out, conv(x))

    dilated = surfconv_ops.surf_conv2d(
        x, conv.weight, conv.bias, scale=torch.full((2, 12, 16), 2.0), padding=1
    )
    torch.testing.assert_close(dilated, F.conv2d(x, conv.weight, conv.bias, 1, 2, 2))

    out.square().mean().backward()
    ours = [x.grad, conv.weight.grad, conv.bias.grad]
    theirs = torch.autograd.grad(conv(x).square().mean(), [x, conv.weight, conv.bias])
    torch.testing.assert_close(ours, list(theirs))
    print(f"wheel smoke test passed: torch {torch.__version__}, instruction set {capability}")


if __name__ == "__main__":
    main()
