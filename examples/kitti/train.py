"""Train the paper's net from scratch on a folder of labelled RGB-D frames.

    python examples/kitti/train.py --data DIR --mode continuous --out runs/continuous-0

Writes into the folder --out: config.json, levels.json, metrics.jsonl (a line an epoch), last.pt
(to go on from; a killed run that is started again with the same command ends with the same
result), best.pt and best.json (the epoch of the best validation IOU_surf), last.json, and at the
end final.pt (the last epoch, without what training needs).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from evaluation import FIGURES, evaluate, without_nan
from folder import FolderError, Frame, FrameFolder, network_input, split
from losses import LOSSES, segmentation_loss
from paper_net import on_device, parameter_count
from schedules import DEFAULT_RATES, SCHEDULES, make_schedule
from segmenter import MODES, CheckpointError, Segmenter, Settings, read_checkpoint, save_checkpoint
from surfconv_ops import DepthLevels, fit_depth_levels

MOMENTUM = 0.9
WEIGHT_DECAY = 5e-4
#: Frames kept in memory; 70 KITTI frames take 180 MB.
FRAMES_IN_MEMORY = 512
#: What --validation may name besides a file.
VALIDATION_FILES = {"kitti": Path(__file__).with_name("validation.txt"), "none": None}


class Training:
    """A run: its data, its net, how far it is, and its folder."""

    def __init__(self, settings: Settings, data: Path, out: Path, device: torch.device) -> None:
        settings.check()
        self.out, self.device = out, device
        self.folder = FrameFolder(data)
        settings = dataclasses.replace(settings, classes=len(self.folder.class_names))
        self.settings = settings
        listed = VALIDATION_FILES.get(settings.validation, Path(settings.validation))
        self.names, self.validation_names = split(self.folder.names, listed)
        self.frame = lru_cache(maxsize=FRAMES_IN_MEMORY)(self.folder.frame)
        self.epoch = 0
        self.best: dict[str, Any] | None = None
        out.mkdir(parents=True, exist_ok=True)
        last = self._read_last()
        if last is None:
            self.levels = self._fit_levels()
        else:
            self.levels = last["levels"]
        torch.manual_seed(settings.seed)
        self.model = Segmenter(settings, self.levels).to(device)
        self.optimizer = torch.optim.SGD(
            self.model.parameters(), settings.rate, MOMENTUM, weight_decay=WEIGHT_DECAY
        )
        self.schedule = make_schedule(
            settings.schedule, self.optimizer, settings.epochs, self.batches_an_epoch
        )
        if last is not None:
            self.model.net.load_state_dict(last["model"])
            self.optimizer.load_state_dict(last["optimizer"])
            self.schedule.load_state_dict(last["schedule"])
            self.epoch, self.best = last["epoch"], last["best"]
        self._start_files()

    @property
    def batches_an_epoch(self) -> int:
        """Number of batches; the last one may be smaller."""
        return -(-len(self.names) // self.settings.batch)

    def _read_last(self) -> dict[str, Any] | None:
        path = self.out / "last.pt"
        if not path.exists():
            return None
        last = read_checkpoint(path)
        changed = [
            f"{name} {value!r} (was {last['settings'].as_dict()[name]!r})"
            for name, value in self.settings.as_dict().items()
            if last["settings"].as_dict()[name] != value
        ]
        if changed:
            raise CheckpointError(
                f"--out: {self.out} holds a run with other settings: {', '.join(changed)}; choose"
                " another folder"
            )
        return last

    def _fit_levels(self) -> DepthLevels:
        shown = tqdm(self.names, desc="depth levels", unit="frame", leave=False)
        depths = torch.cat([self.frame(name).depth.flatten() for name in shown])
        return fit_depth_levels(depths, self.settings.levels, self.settings.gamma)

    def _start_files(self) -> None:
        config = {
            **self.settings.as_dict(),
            "parameters": parameter_count(self.model),
            "frames": len(self.names),
            "validation_frames": len(self.validation_names),
            "device": str(self.device),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
        }
        self._write("config.json", config)
        self.levels.save(self.out / "levels.json")
        # A kill between the line and the checkpoint leaves a line too many.
        path = self.out / "metrics.jsonl"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        kept = [line for line in lines if json.loads(line)["epoch"] <= self.epoch]
        path.write_text("".join(line + "\n" for line in kept), encoding="utf-8")

    def _write(self, name: str, content: dict[str, Any]) -> None:
        partial = self.out / (name + ".partial")
        partial.write_text(json.dumps(without_nan(content), indent=2) + "\n", encoding="utf-8")
        partial.replace(self.out / name)

    def batches(self, epoch: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Input, depth and label of an epoch's batches; order and flips follow from the seed."""
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + epoch)
        order = torch.randperm(len(self.names), generator=generator).tolist()
        flips = (torch.rand(len(self.names), generator=generator) < 0.5).tolist()
        for start in range(0, len(order), self.settings.batch):
            chosen = order[start : start + self.settings.batch]
            yield self._batch(
                [self.frame(self.names[i]) for i in chosen], [flips[i] for i in chosen]
            )

    def _batch(self, frames: list[Frame], flips: list[bool]) -> tuple[Tensor, Tensor, Tensor]:
        sizes = {tuple(frame.depth.shape) for frame in frames}
        if len(sizes) > 1:
            raise FolderError(
                f"frames {', '.join(f.name for f in frames)} differ in size: {sorted(sizes)};"
                " use --batch 1"
            )

        def stacked(maps: list[Tensor]) -> Tensor:
            both = zip(maps, flips, strict=True)
            return torch.stack([m.flip(-1) if flip else m for m, flip in both]).to(self.device)

        return (
            stacked([network_input(frame) for frame in frames]),
            stacked([frame.depth for frame in frames]),
            stacked([frame.label for frame in frames]).long(),
        )

    def run(self) -> None:
        """Train from where the run stands to its last epoch."""
        settings = self.settings
        bar = tqdm(
            total=settings.epochs * self.batches_an_epoch,
            initial=self.epoch * self.batches_an_epoch,
            desc=f"{settings.mode}, epoch {self.epoch}",
            unit="batch",
        )
        with bar:
            for epoch in range(self.epoch + 1, settings.epochs + 1):
                line = {"epoch": epoch, **self._train_epoch(epoch, bar)}
                if self.validation_names:
                    line["val"] = self._validate()
                    bar.set_postfix(iou_surf=f"{line['val']['iou_surf']:.4f}")
                self._finish_epoch(line)
        known = json.loads((self.out / "last.json").read_text(encoding="utf-8"))
        save_checkpoint(self.out / "final.pt", self.model, settings, self.levels, **known)

    def _train_epoch(self, epoch: int, bar: tqdm[Any]) -> dict[str, Any]:
        started, total = time.perf_counter(), 0.0
        bar.set_description(f"{self.settings.mode}, epoch {epoch}")
        rate = self.optimizer.param_groups[0]["lr"]
        for input, depth, label in self.batches(epoch):
            loss = segmentation_loss(
                self.model(input, depth),
                label,
                depth,
                kind=self.settings.loss,
                levels=self.levels,
                reference_depth=self.settings.reference_depth,
            )
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.schedule.after_batch()
            total += loss.item()
            bar.update()
        seconds = time.perf_counter() - started
        return {"train_loss": total / self.batches_an_epoch, "rate": rate, "seconds": seconds}

    def _validate(self) -> dict[str, float]:
        frames = (self.frame(name) for name in self.validation_names)
        figures = evaluate(self.model, frames, self.device).compute()
        return {name: figures[name] for name in FIGURES}

    def _finish_epoch(self, line: dict[str, Any]) -> None:
        self.epoch = line["epoch"]
        validated = line.get("val")
        self.schedule.after_epoch(self.epoch, None if validated is None else validated["iou_surf"])
        known = {"epoch": self.epoch, "val": validated}
        better = (
            validated is None
            or self.best is None
            or math.isnan(self.best["val"]["iou_surf"])
            or validated["iou_surf"] > self.best["val"]["iou_surf"]
        )
        with (self.out / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(without_nan(line)) + "\n")
        if better:
            self.best = known
            save_checkpoint(self.out / "best.pt", self.model, self.settings, self.levels, **known)
            self._write("best.json", known)
        self._write("last.json", known)
        # Last of all: a run goes on from here.
        save_checkpoint(
            self.out / "last.pt",
            self.model,
            self.settings,
            self.levels,
            **known,
            best=self.best,
            optimizer=self.optimizer.state_dict(),
            schedule=self.schedule.state_dict(),
        )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    defaults = {f.name: f.default for f in dataclasses.fields(Settings)}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder with rgb/, depth/, hha/ and label/")
    add("--out", type=Path, required=True, help="folder of the run")
    add("--mode", choices=MODES, required=True)
    add("--levels", type=int, default=defaults["levels"], help="number of depth levels (4)")
    add("--gamma", type=float, default=defaults["gamma"], help="D4's exponent of importance (1)")
    add("--capacity", type=int, default=defaults["capacity"], help="times the net's widths (1)")
    add("--loss", choices=LOSSES, default=defaults["loss"], help="weights of pixels (image)")
    add("--seed", type=int, default=defaults["seed"])
    add("--epochs", type=int, default=defaults["epochs"])
    add("--batch", type=int, default=defaults["batch"])
    add("--schedule", choices=SCHEDULES, default=defaults["schedule"], help="of the rate (cosine)")
    add("--rate", type=float, help=f"first learning rate ({DEFAULT_RATES}, by schedule)")
    add("--reference-depth", type=float, default=defaults["reference_depth"], help="metres (25.9)")
    add("--invalid-scale", type=float, default=defaults["invalid_scale"])
    add("--min-scale", type=float, default=defaults["min_scale"])
    add("--max-scale", type=float, default=defaults["max_scale"])
    add("--depth-window", type=float, help="metres; continuous mode only")
    add("--same-level-only", action="store_true", help="levels and pyramid: see own level only")
    add("--pools", action="store_true", help="scale the max pool's window too")
    add(
        "--validation",
        default=defaults["validation"],
        help="file of the names of frames to validate on, 'none', or 'kitti': 14 of the 70 (kitti)",
    )
    add("--device", default="auto", help="cpu, cuda or auto")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Train, or say what is wrong."""
    args = parse(arguments)
    names = {f.name for f in dataclasses.fields(Settings)}
    chosen = {name: value for name, value in vars(args).items() if name in names}
    if chosen["rate"] is None:
        chosen["rate"] = DEFAULT_RATES[args.schedule]
    try:
        training = Training(Settings(**chosen), args.data, args.out, on_device(args.device))
        training.run()
    except (FolderError, CheckpointError, ValueError) as error:
        sys.exit(f"train.py: {error}")
    best = training.best
    if best is not None and best["val"] is not None:
        figures = ", ".join(f"{name} {100 * best['val'][name]:.2f}" for name in FIGURES)
        print(f"best epoch {best['epoch']} of {training.epoch}, validation in percent: {figures}")
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
