"""NYU Depth v2's labelled frames: read one at a time, or written out as train.py's folder.

    python examples/kitti/nyuv2.py export nyu_depth_v2_labeled.mat --mapping classMapping40.mat \\
        --splits splits.mat --out nyuv2
    python examples/kitti/train.py --data nyuv2 --validation nyuv2/test.txt ...

The file is MATLAB's 7.3 format, which is HDF5. MATLAB stores arrays column by column, so HDF5 shows
every axis in reverse: `images`, 480 x 640 x 3 x 1449 in MATLAB, is (1449, 3, 640, 480) here.
Silberman et al., "Indoor Segmentation and Support Inference from RGBD Images", ECCV 2012.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from folder import FOLDERS, Frame
from hha import ENCODINGS, Intrinsics, compute_hha, encode
from nyuv2_labels import LabelMapping, NYUError, read_mapping, read_splits

#: Of the colour camera, which the depth was projected into; published with the data's toolbox.
CAMERA = Intrinsics(518.857901, 519.469611, 325.582449, 253.736166)
#: 13.1 m in 16 bits; the sensor reaches 10 m.
METRES_PER_COUNT = 0.0002


class NYUv2(Sequence[Frame]):
    """The frames of nyu_depth_v2_labeled.mat, each read from the file when it is asked for.

    Args:
        path: the file.
        mapping: what class each label stands for; None leaves labels as they are.
        raw: the sensor's own depth, with its holes, instead of the one that was filled in.
        chosen: positions (from 0) of the frames to show, in this order; None shows all.
        encoding: of the HHA picture, see `hha.encode`.
        intrinsics: of the camera.

    Raises:
        NYUError: the file is of another kind, or a frame is asked for that it does not hold.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        mapping: LabelMapping | None = None,
        raw: bool = False,
        chosen: Sequence[int] | NDArray[np.int64] | None = None,
        encoding: str = "gupta",
        intrinsics: Intrinsics = CAMERA,
    ) -> None:
        self.path = Path(path)
        self.mapping, self.encoding, self.intrinsics = mapping, encoding, intrinsics
        self._file = _open(self.path)
        self._depth = "rawDepths" if raw else "depths"
        try:
            count = self._check()
            self.chosen = list(range(count)) if chosen is None else [int(k) for k in chosen]
            beyond = [k for k in self.chosen if not 0 <= k < count]
            if beyond:
                raise NYUError(
                    f"{self.path} holds {count} frames; frame {beyond[0] + 1} was asked for"
                )
            labels = len(self.label_names())
            if mapping is not None and len(mapping.table) != labels + 1:
                raise NYUError(
                    f"mapping: expected a class for each of the {labels} labels of {self.path}, "
                    f"got {len(mapping.table) - 1}"
                )
        except BaseException:
            self.close()
            raise

    def _check(self) -> int:
        needed = ("images", self._depth, "labels", "names")
        missing = [name for name in needed if name not in self._file]
        if missing:
            raise NYUError(
                f"{self.path} has no {' or '.join(missing)}; expected nyu_depth_v2_labeled.mat"
            )
        count, _, width, height = (*self._file["images"].shape, 0, 0, 0, 0)[:4]
        shapes = {
            "images": (count, 3, width, height),
            self._depth: (count, width, height),
            "labels": (count, width, height),
        }
        for name, shape in shapes.items():
            if self._file[name].shape != shape:
                raise NYUError(
                    f"{self.path}: {name} has shape {self._file[name].shape}; expected {shape}, "
                    "frames first, then columns before rows"
                )
        return int(count)

    def label_names(self) -> list[str]:
        """The English names of labels 1, 2, ..."""
        return read_names(self._file)

    def __len__(self) -> int:
        return len(self.chosen)

    def name(self, index: int) -> str:
        """The frame's number in the whole file, counted from 1 as in splits.mat."""
        return f"{self.chosen[index] + 1:04d}"

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        where = self.chosen[index]
        # One frame's slice of each dataset is all that is read.
        rgb = np.ascontiguousarray(self._file["images"][where].transpose(2, 1, 0))
        metres = np.ascontiguousarray(self._file[self._depth][where].T)
        metres = np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)
        label = np.ascontiguousarray(self._file["labels"][where].T).astype(np.int32)
        if self.mapping is not None:
            label = self.mapping.table[label]
        hha = encode(compute_hha(metres, self.intrinsics), self.encoding)
        return Frame(self.name(index), rgb, hha, torch.from_numpy(metres), torch.from_numpy(label))

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> NYUv2:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _open(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise NYUError("reading NYUv2 needs h5py: pip install 'surfconv_ops[kitti]'") from None
    if not path.is_file():
        raise NYUError(f"{path}: no such file")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise NYUError(f"{path} is not a MATLAB 7.3 (HDF5) file: {error}") from None


def read_names(file: Any) -> list[str]:
    """The cell array `names`: a reference each to an array of UTF-16 code units."""
    references = np.asarray(file["names"]).ravel()
    units = (np.asarray(file[reference]).astype("<u2").ravel() for reference in references)
    return [unit.tobytes().decode("utf-16-le") for unit in units]


def export(frames: NYUv2, out: Path, metres_per_count: float = METRES_PER_COUNT) -> None:
    """Write the frames as train.py's folder: rgb/, depth/, hha/, label/ and dataset.json.

    Args:
        frames: with labels mapped to at most 255 classes.
        out: the folder; made, and refused where it holds something already.
        metres_per_count: of the 16-bit depth.

    Raises:
        NYUError: the folder is not empty, or a depth or label does not fit its picture.
    """
    if not 0 < metres_per_count < np.inf:
        raise NYUError(f"metres_per_count: expected a positive number, got {metres_per_count}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise NYUError(f"--out: {out} exists and is not empty")
    for name in FOLDERS:
        (out / name).mkdir(parents=True)
    for frame in tqdm(frames, desc="export", unit="frame"):
        counts = np.rint(frame.depth.numpy().astype(np.float64) / metres_per_count)
        if counts.max(initial=0) > 65535:
            raise NYUError(
                f"frame {frame.name} is {float(frame.depth.max()):.2f} m deep; 16 bits of "
                f"{metres_per_count} m end at {65535 * metres_per_count:.2f} m: give a greater unit"
            )
        label = frame.label.numpy()
        if label.max(initial=0) > 255:
            raise NYUError(
                f"frame {frame.name} holds label {label.max()}; 8 bits end at 255: give a mapping"
            )
        pictures = {
            "rgb": frame.rgb,
            "depth": counts.astype(np.uint16),
            "hha": frame.hha,
            "label": label.astype(np.uint8),
        }
        for folder, picture in pictures.items():
            Image.fromarray(picture).save(out / folder / f"{frame.name}.png")
    known = frames.mapping.class_names if frames.mapping is not None else None
    names = known or ["ignored", *frames.label_names()]
    about = {"metres_per_count": metres_per_count, "classes": names}
    (out / "dataset.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def _export(chosen: argparse.Namespace) -> None:
    with NYUv2(chosen.file) as whole:
        names, count = whole.label_names(), len(whole)
    mapping = read_mapping(chosen.mapping, names, chosen.classes) if chosen.mapping else None
    parts = read_splits(chosen.splits, count) if chosen.splits else {}
    wanted = None if chosen.split == "all" else parts[chosen.split]
    options: dict[str, Any] = {"raw": chosen.raw, "chosen": wanted, "encoding": chosen.hha}
    with NYUv2(chosen.file, mapping=mapping, **options) as frames:
        export(frames, chosen.out, chosen.unit)
        print(f"wrote {len(frames)} frames to {chosen.out}")
    if wanted is None:
        for part, where in parts.items():
            lines = "".join(f"{k + 1:04d}\n" for k in where)
            (chosen.out / f"{part}.txt").write_text(lines, encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="export")
    add = commands.add_parser("export", help="write the frames as train.py's folder").add_argument
    add("file", type=Path, help="nyu_depth_v2_labeled.mat")
    add("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    add("--mapping", type=Path, help="class of each label: classMapping40.mat, .json or .npy")
    add("--classes", type=int, default=37, help="keep classes 1 to N, ignore those above (37)")
    add("--splits", type=Path, help="splits.mat; with --split all, train.txt and test.txt follow")
    add("--split", choices=("all", "train", "test"), default="all", help="frames to write (all)")
    add("--raw", action="store_true", help="the sensor's own depth, with its holes")
    add("--unit", type=float, default=METRES_PER_COUNT, help="metres per count of depth (0.0002)")
    add("--hha", choices=ENCODINGS, default="gupta", help="encoding of hha/ (gupta)")
    chosen = parser.parse_args(arguments)
    if chosen.split != "all" and chosen.splits is None:
        parser.error("--split: which frames are in it, is in --splits")
    try:
        _export(chosen)
    except (NYUError, OSError) as error:
        print(f"nyuv2.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
