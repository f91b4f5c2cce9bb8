"""SurfConv: 2D convolution whose footprint follows the depth of the surface it looks at."""

from types import ModuleType

from . import reference
from .conversion import convert_conv2d
from .convertible import conversion_report
from .d4 import D4, fit_depth_levels
from .depth import at_output_centers, depth_to_scale
from .functional import surf_conv2d
from .guided import DepthGuided
from .levels import DepthLevels
from .metrics import SegmentationMetrics
from .modules import SurfConv2d
from .pool_functional import surf_avg_pool2d, surf_max_pool2d
from .pools import SurfAvgPool2d, SurfMaxPool2d
from .pyramid import SurfConvPyramid

__version__ = "0.1.0"

__all__ = [
    "D4",
    "DepthGuided",
    "DepthLevels",
    "SegmentationMetrics",
    "SurfAvgPool2d",
    "SurfConv2d",
    "SurfConvPyramid",
    "SurfMaxPool2d",
    "__version__",
    "at_output_centers",
    "conversion_report",
    "convert_conv2d",
    "depth_to_scale",
    "fit_depth_levels",
    "reference",
    "surf_avg_pool2d",
    "surf_conv2d",
    "surf_max_pool2d",
]


def __getattr__(name: str) -> ModuleType:
    # Imported on use alone: Triton takes longer to import than the whole package.
    if name == "triton":
        from importlib import import_module

        return import_module(".triton", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
