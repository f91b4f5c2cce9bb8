"""Which class each of NYUv2's 894 labels stands for, and which frames train and test."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class NYUError(ValueError):
    """NYUv2's files cannot be used; the message says what is wrong with them."""


class LabelMapping(NamedTuple):
    """`table[label]` is the class, 0 = ignored, label 0 included; names by class where known."""

    table: NDArray[np.int32]
    class_names: list[str] | None


def read_mapping(path: Path, label_names: Sequence[str], classes: int | None = 37) -> LabelMapping:
    """Read which class each label stands for.

    The usual mapping is to 40 classes, of which the last three are for what has no class of its
    own (other structure, other furniture, other prop). The usual 37 classes ignore those.

    Args:
        path: classMapping40.mat or its like (`mapClass`: the class of label 1, 2, ...; names in
            `className`), a .npy file of such a list, or a .json file: such a list, or an object
            from label name to class, in which labels that are not named are ignored.
        label_names: the names of labels 1, 2, ..., from the data file.
        classes: classes above are ignored; None keeps all.

    Raises:
        NYUError: the file cannot be read, or does not fit the labels.
    """
    if not path.is_file():
        raise NYUError(f"--mapping: no such file: {path}")
    names: list[str] | None = None
    if path.suffix == ".mat":
        content = _load_mat(path, "--mapping")
        if "mapClass" not in content:
            raise NYUError(f"--mapping: {path} holds no mapClass")
        values = np.asarray(content["mapClass"]).ravel()
        if "className" in content:
            names = [str(np.asarray(cell).item()) for cell in np.ravel(content["className"])]
    elif path.suffix == ".npy":
        try:
            values = np.load(path)
        except (ValueError, OSError, EOFError) as error:
            raise NYUError(f"--mapping: {path} is not an array of NumPy's: {error}") from None
    elif path.suffix == ".json":
        values = _from_json(path, label_names)
    else:
        raise NYUError(f"--mapping: expected a .mat, .npy or .json file, got {path}")
    if values.shape != (len(label_names),) or values.dtype.kind not in "iuf":
        raise NYUError(
            f"--mapping: expected a class for each of {len(label_names)} labels, got "
            f"{values.shape} of {values.dtype} in {path}"
        )
    if not ((values >= 0) & (values == np.floor(values)) & (values < 2**15)).all():
        raise NYUError(f"--mapping: {path} holds classes that are not whole numbers from 0")
    table = np.concatenate([[0], values]).astype(np.int32)
    if classes is not None:
        table[table > classes] = 0
    top = int(table.max(initial=0))
    named = ["ignored", *names[:top]] if names is not None and len(names) >= top else None
    return LabelMapping(table, named)


def _from_json(path: Path, label_names: Sequence[str]) -> NDArray[Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise NYUError(f"--mapping: {path} is not JSON: {error}") from None
    if not isinstance(content, dict):
        return np.array(content)
    unknown = sorted(set(content) - set(label_names))
    if unknown:
        raise NYUError(f"--mapping: {path} names labels that the data has not: {unknown[:5]}")
    return np.array([content.get(name, 0) for name in label_names])


def _load_mat(path: Path, argument: str) -> dict[str, Any]:
    try:
        from scipy.io import loadmat
    except ImportError:
        raise NYUError(
            f"{argument}: reading {path} needs SciPy: pip install 'surfconv_ops[kitti]'"
        ) from None
    try:
        content: dict[str, Any] = loadmat(path)
    except Exception as error:  # whatever the bytes of a damaged file lead it to
        raise NYUError(f"{argument}: {path} is not a MATLAB file up to 7.2: {error}") from None
    return content


def read_splits(path: Path, count: int) -> dict[str, NDArray[np.int64]]:
    """Positions (from 0) of the frames of splits.mat: {'train': ..., 'test': ...}.

    Args:
        path: the file; its trainNdxs and testNdxs count from 1.
        count: frames in the data file.

    Raises:
        NYUError: the file is of another kind, or names a frame twice or one that is not there.
    """
    if not path.is_file():
        raise NYUError(f"--splits: no such file: {path}")
    content = _load_mat(path, "--splits")
    parts = {}
    for part, key in (("train", "trainNdxs"), ("test", "testNdxs")):
        if key not in content:
            raise NYUError(f"--splits: {path} holds no {key}")
        parts[part] = np.asarray(content[key]).ravel().astype(np.int64) - 1
    every = np.concatenate(list(parts.values()))
    if every.size and not (every.min() >= 0 and every.max() < count):
        raise NYUError(
            f"--splits: {path} names frames {every.min() + 1} to {every.max() + 1}; the data holds "
            f"1 to {count}"
        )
    if len(np.unique(every)) != len(every):
        raise NYUError(f"--splits: {path} names a frame twice")
    return parts
