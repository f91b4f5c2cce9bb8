"""Nets of other packages, converted without an edit; random weights, nothing is downloaded."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from surfconv_ops import DepthGuided, SurfConv2d, conversion_report, convert_conv2d

transformers = pytest.importorskip("transformers", reason="transformers is not installed")
monai_nets = pytest.importorskip("monai.networks.nets", reason="MONAI is not installed")


def resnet() -> nn.Module:
    config = transformers.ResNetConfig(
        embedding_size=8, hidden_sizes=[8, 12, 16], depths=[2, 1, 1], layer_type="basic"
    )
    return transformers.ResNetModel(config)


def bottleneck_backbone() -> nn.Module:
    config = transformers.ResNetConfig(
        embedding_size=8, hidden_sizes=[16, 32], depths=[1, 2], out_features=["stage1", "stage2"]
    )
    return transformers.ResNetBackbone(config)


def segformer() -> nn.Module:
    config = transformers.SegformerConfig(
        depths=[1, 1, 1, 1],
        hidden_sizes=[8, 8, 16, 16],
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16,
        num_labels=5,
        drop_path_rate=0.0,
    )
    return transformers.SegformerForSemanticSegmentation(config)


def convnext() -> nn.Module:
    config = transformers.ConvNextConfig(depths=[1, 1, 1, 1], hidden_sizes=[8, 8, 16, 16])
    return transformers.ConvNextModel(config)


def unet() -> nn.Module:
    return monai_nets.UNet(
        spatial_dims=2, in_channels=3, out_channels=4, channels=(4, 8, 16), strides=(2, 2),
        num_res_units=1,
    )  # fmt: skip


def basic_unet() -> nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return monai_nets.BasicUNet(
            spatial_dims=2, in_channels=3, out_channels=2, features=(4, 4, 8, 8, 8, 4)
        )


# The convolutions larger than 1 x 1 that each net has, counted in its description.
NETS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "transformers ResNet": (resnet, 9),
    "transformers ResNet backbone": (bottleneck_backbone, 4),
    "transformers SegFormer": (segformer, 11),
    "transformers ConvNeXt": (convnext, 8),
    "MONAI UNet": (unet, 7),
    "MONAI BasicUNet": (basic_unet, 18),
}


def tensors(output: Any) -> list[Tensor]:
    if isinstance(output, Tensor):
        return [output]
    values = output.to_tuple() if hasattr(output, "to_tuple") else output
    return [t for value in values for t in tensors(value)]


@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize("training", [True, False])
def test_net(name: str, training: bool) -> None:
    make, count = NETS[name]
    net = make().train(training).double()
    for module in net.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    x = torch.randn(2, 3, 64, 96, dtype=torch.float64)
    plain = copy.deepcopy(net)
    expected = tensors(plain(x))
    state = plain.state_dict()

    guided = DepthGuided(convert_conv2d(net, reference_depth=2.0))
    report = conversion_report(net)
    assert len(report.converted) == count
    assert sum(type(m) is SurfConv2d for m in net.modules()) == count
    assert all(" 1 x 1" in row.why or "Conv2d(" not in row.was for row in report.unchanged)

    guided.load_state_dict(state)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        at_reference = tensors(guided(x, depth=torch.full((2, 64, 96), 2.0)))
    assert len(at_reference) == len(expected)
    for ours, wanted in zip(at_reference, expected, strict=True):
        # Outputs of zeros would agree with anything.
        assert wanted.std() > 0
        torch.testing.assert_close(ours, wanted, rtol=1e-8, atol=1e-9)

    depth = torch.rand(2, 64, 96) * 4 + 0.5
    outputs = tensors(guided(x, depth=depth))
    assert any((o - e).abs().max() > 1e-3 for o, e in zip(outputs, expected, strict=True))

    guided.zero_grad()
    sum(o.square().mean() for o in outputs).backward()  # type: ignore[union-attr]
    trained = [m.weight.grad for m in net.modules() if isinstance(m, SurfConv2d)]
    assert all(g is not None and g.isfinite().all() and g.abs().sum() > 0 for g in trained)


@pytest.mark.filterwarnings("ignore:.gradient_checkpointing_enable")
def test_gradient_checkpointing_of_transformers() -> None:
    """Its own switch raises in backward, and with DepthGuided's contexts is right."""
    torch.manual_seed(1)
    net = segformer().train()
    for module in net.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    guided = DepthGuided(convert_conv2d(net, reference_depth=2.0))
    x, depth = torch.randn(1, 3, 64, 64), torch.rand(1, 64, 64) + 1

    def gradients() -> list[Tensor]:
        guided.zero_grad()
        guided(x, depth=depth).logits.square().mean().backward()
        return [p.grad.clone() for p in net.parameters() if p.grad is not None]

    expected = gradients()
    net.gradient_checkpointing_enable({"use_reentrant": False})
    with pytest.raises(ValueError, match="got None"):
        gradients()
    options = {"use_reentrant": False, "context_fn": DepthGuided.checkpoint_contexts}
    net.gradient_checkpointing_enable(options)
    for ours, wanted in zip(gradients(), expected, strict=True):
        torch.testing.assert_close(ours, wanted)
