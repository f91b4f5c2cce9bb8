"""Evaluate a checkpoint of train.py on a folder of labelled RGB-D frames, also one it never saw.

    python examples/kitti/evaluate.py --checkpoint runs/continuous-0/best.pt --data DIR

Prints the paper's four figures, each class and each range of depth; writes them to metrics.json
and a page of pictures (frame, labels, prediction, error) to pictures.png in --out.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from torch import Tensor
from tqdm import tqdm

from classes import palette
from evaluation import evaluate, report, without_nan
from folder import FolderError, Frame, FrameFolder
from paper_net import on_device
from pictures import FramePictures, page
from segmenter import CheckpointError, read_checkpoint, restore


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--checkpoint", type=Path, required=True, help="final.pt, best.pt or last.pt of a run")
    add("--data", type=Path, required=True, help="folder with rgb/, depth/, hha/ and label/")
    add("--out", type=Path, help="folder for metrics.json and pictures.png (the checkpoint's)")
    add("--names", type=Path, help="file of the names of frames to evaluate (all frames)")
    add("--pictures", type=int, default=6, help="frames on the page, spread over the folder (6)")
    add("--device", default="auto", help="cpu, cuda or auto")
    return parser.parse_args(arguments)


def run(args: argparse.Namespace) -> None:
    """Evaluate, print, write."""
    content = read_checkpoint(args.checkpoint)
    settings = content["settings"]
    device = on_device(args.device)
    model = restore(content).to(device)
    folder = FrameFolder(args.data)
    if len(folder.class_names) != settings.classes:
        raise FolderError(
            f"--data: {args.data} has {len(folder.class_names)} classes, the net was trained for"
            f" {settings.classes}"
        )
    names = folder.names if args.names is None else _chosen(folder, args.names)
    places = np.linspace(0, len(names) - 1, min(max(args.pictures, 0), len(names)))
    shown = {names[int(place)] for place in places.round()}
    rows: list[FramePictures] = []

    def keep(frame: Frame, prediction: Tensor) -> None:
        if frame.name in shown:
            label, depth = frame.label.numpy(), frame.depth.numpy()
            rows.append((frame.name, frame.rgb, label, prediction.numpy(), depth))

    bar = tqdm(names, desc="frames", unit="frame")
    metrics = evaluate(model, (folder.frame(name) for name in bar), device, keep).compute()

    print(
        f"{args.checkpoint}: {settings.mode}, epoch {content['epoch']} of {settings.epochs}, on"
        f" {len(names)} frames of {args.data}\n"
    )
    print(report(metrics, folder.class_names))
    out = args.out or args.checkpoint.parent
    out.mkdir(parents=True, exist_ok=True)
    written = {
        "settings": settings.as_dict(),
        "epoch": content["epoch"],
        "frames": names,
        "metrics": metrics,
    }
    (out / "metrics.json").write_text(
        json.dumps(without_nan(written), indent=2) + "\n", encoding="utf-8"
    )
    if rows:
        page(rows, folder.class_names, palette(settings.classes), out / "pictures.png")
    print(f"\nwrote {out / 'metrics.json'}" + (f" and {out / 'pictures.png'}" if rows else ""))


def _chosen(folder: FrameFolder, path: Path) -> list[str]:
    if not path.is_file():
        raise FolderError(f"--names: no such file: {path}")
    lines = (line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    names = [line for line in lines if line]
    unknown = [name for name in names if name not in folder.names]
    if unknown or not names:
        what = f"names {unknown[0]}, which is not in {folder.path}" if unknown else "names no frame"
        raise FolderError(f"--names: {path} {what}")
    return names


def main(arguments: list[str] | None = None) -> None:
    """Evaluate, or say what is wrong."""
    args = parse(arguments)
    try:
        run(args)
    except (FolderError, CheckpointError, ValueError) as error:
        sys.exit(f"evaluate.py: {error}")


if __name__ == "__main__":
    main()
