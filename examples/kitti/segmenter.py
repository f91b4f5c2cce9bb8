"""One net, four ways to run it, and the checkpoint that holds all a run needs to be repeated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from paper_net import CLASSES, PaperNet
from surfconv_ops import DepthGuided, DepthLevels, SurfConvPyramid, convert_conv2d

MODES = ("conv2d", "pyramid", "levels", "continuous")
FORMAT = "surfconv_ops kitti checkpoint 1"


#: Settings that not every mode has a use for, and the modes that have.
_FUSED = ("levels", "continuous")
_USED_BY = {
    "min_scale": _FUSED,
    "max_scale": _FUSED,
    "pools": _FUSED,
    "depth_window": ("continuous",),
    "same_level_only": ("pyramid", "levels"),
    "invalid_scale": ("pyramid", *_FUSED),
}


class CheckpointError(ValueError):
    """A file is not a checkpoint of this example."""


@dataclass(frozen=True)
class Settings:
    """Everything that decides the outcome of a run; the names are those of the arguments."""

    mode: str
    levels: int = 4
    gamma: float = 1.0
    capacity: int = 1
    loss: str = "image"
    seed: int = 0
    epochs: int = 100
    batch: int = 2
    schedule: str = "cosine"
    rate: float = 0.01
    reference_depth: float = 25.9
    invalid_scale: float = 1.0
    min_scale: float = 0.0
    max_scale: float = float("inf")
    depth_window: float | None = None
    same_level_only: bool = False
    pools: bool = False
    validation: str = "kitti"
    classes: int = CLASSES

    def check(self) -> None:
        """Raise ValueError where a setting is out of range or would do nothing in this mode."""
        if self.mode not in MODES:
            raise ValueError(f"mode: expected one of {MODES}, got {self.mode!r}")
        for name in ("levels", "capacity", "epochs", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        for field in dataclasses.fields(self):
            modes = _USED_BY.get(field.name, MODES)
            if self.mode not in modes and getattr(self, field.name) != field.default:
                raise ValueError(f"{field.name}: mode {self.mode} has no use for it, only {modes}")

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return dataclasses.asdict(self)


class Segmenter(nn.Module):
    """The paper's net in one of the four modes.

    Args:
        settings: the run's.
        levels: depth levels of the training frames; modes `pyramid` and `levels` use them.
    """

    def __init__(self, settings: Settings, levels: DepthLevels) -> None:
        super().__init__()
        settings.check()
        self.classes = settings.classes
        self.net = PaperNet(settings.capacity, classes=settings.classes)
        # In a list, so that the parameters are registered once and a checkpoint's keys are the
        # plain net's in every mode.
        self._runner = [_runner(settings, levels, self.net)]

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        """Scores (N, classes, H, W) of frames (N, 6, H, W) with depth (N, H, W) in metres."""
        scores: Tensor = self._runner[0](input, depth)
        return scores


class _Plain(nn.Module):
    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        scores: Tensor = self.net(input)
        return scores


class _Guided(nn.Module):
    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.guided = DepthGuided(net)

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        scores: Tensor = self.guided(input, depth=depth)
        return scores


def _runner(settings: Settings, levels: DepthLevels, net: nn.Module) -> nn.Module:
    if settings.mode == "conv2d":
        return _Plain(net)
    if settings.mode == "pyramid":
        return SurfConvPyramid(
            net,
            levels,
            settings.reference_depth,
            same_level_only=settings.same_level_only,
            invalid_scale=settings.invalid_scale,
        )
    convert_conv2d(
        net,
        reference_depth=settings.reference_depth,
        levels=levels if settings.mode == "levels" else None,
        pools=settings.pools,
        depth_window=settings.depth_window,
        same_level_only=settings.same_level_only,
        invalid_scale=settings.invalid_scale,
        min_scale=settings.min_scale,
        max_scale=settings.max_scale,
    )
    return _Guided(net)


def save_checkpoint(
    path: Path, model: Segmenter, settings: Settings, levels: DepthLevels, **more: Any
) -> None:
    """Write a checkpoint in one step, so that a kill leaves the old one or the new one."""
    content = {
        "format": FORMAT,
        "settings": settings.as_dict(),
        "levels": levels.to_dict(),
        "model": model.net.state_dict(),
        **more,
    }
    partial = path.with_suffix(".partial")
    torch.save(content, partial)
    partial.replace(path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint: settings, levels, model and what training added.

    Raises:
        CheckpointError: The file is missing or something else.
    """
    if not path.is_file():
        raise CheckpointError(f"--checkpoint: no such file: {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(f"--checkpoint: {path} is not a checkpoint: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"--checkpoint: {path} was not written by train.py")
    content["settings"] = Settings(**content["settings"])
    content["levels"] = DepthLevels(**content["levels"])
    return content


def restore(content: dict[str, Any]) -> Segmenter:
    """The trained net of a checkpoint."""
    model = Segmenter(content["settings"], content["levels"])
    model.net.load_state_dict(content["model"])
    return model
