"""Names and colours of the classes that the KITTI labels hold."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray

#: By id; 0 is ignored. The label files carry no names. These were told from where each id lies in
#: the frames, and they come in the order of the CamVid classes as commonly listed, without sky.
#: Markings include tram rails and their bed, fences also bollards and bins, cyclists bicycles.
KITTI_CLASSES = (
    "ignored",
    "building",
    "pole",
    "road marking",
    "road",
    "sidewalk",
    "vegetation",
    "sign",
    "fence",
    "car",
    "pedestrian",
    "cyclist",
)
_KITTI_COLOURS = (
    "000000",
    "a65628",
    "f2c200",
    "ffffff",
    "7f7fb2",
    "e78ac3",
    "3f9b3f",
    "ff7f00",
    "b3b36b",
    "2f6fe0",
    "7b2cbf",
    "00d5d5",
)


def palette(num_classes: int) -> NDArray[np.uint8]:
    """Colours to tell classes apart by: black for id 0, then one for each.

    Args:
        num_classes: how many ids there are, the ignored one included.

    Returns:
        (num_classes, 3) RGB; KITTI's own colours where there are twelve.
    """
    if num_classes == len(_KITTI_COLOURS):
        return np.array([list(bytes.fromhex(colour)) for colour in _KITTI_COLOURS], np.uint8)
    # Steps of the golden ratio keep the hues of neighbouring ids apart, whatever their number.
    hues = (np.arange(num_classes - 1) * 0.618034) % 1.0
    rest = [
        colorsys.hsv_to_rgb(hue, (0.9, 0.55)[k % 2], (1.0, 0.8, 0.6)[k % 3])
        for k, hue in enumerate(hues)
    ]
    return (255 * np.array([(0.0, 0.0, 0.0), *rest])).round().astype(np.uint8)
