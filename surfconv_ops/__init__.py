"""SurfConv: 2D convolution whose footprint follows the depth of the surface it looks at."""

from . import reference
from .depth import at_output_centers, depth_to_scale
from .functional import surf_conv2d
from .levels import DepthLevels
from .metrics import SegmentationMetrics
from .modules import SurfConv2d
from .pyramid import SurfConvPyramid

__version__ = "0.1.0"

__all__ = [
    "DepthLevels",
    "SegmentationMetrics",
    "SurfConv2d",
    "SurfConvPyramid",
    "__version__",
    "at_output_centers",
    "depth_to_scale",
    "reference",
    "surf_conv2d",
]
