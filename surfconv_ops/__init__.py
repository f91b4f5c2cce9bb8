"""SurfConv: 2D convolution whose footprint follows the depth of the surface it looks at."""

from . import reference
from .d4 import D4, fit_depth_levels
from .depth import at_output_centers, depth_to_scale
from .functional import surf_conv2d
from .levels import DepthLevels
from .modules import SurfConv2d

__version__ = "0.1.0"

__all__ = [
    "D4",
    "DepthLevels",
    "SurfConv2d",
    "__version__",
    "at_output_centers",
    "depth_to_scale",
    "fit_depth_levels",
    "reference",
    "surf_conv2d",
]
