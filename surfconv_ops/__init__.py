"""SurfConv: 2D convolution whose footprint follows the depth of the surface it looks at."""

from . import reference
from .depth import at_output_centers, depth_to_scale
from .functional import surf_conv2d
from .levels import DepthLevels
from .modules import SurfConv2d
from .pool_functional import surf_avg_pool2d, surf_max_pool2d
from .pools import SurfAvgPool2d, SurfMaxPool2d

__version__ = "0.1.0"

__all__ = [
    "DepthLevels",
    "SurfAvgPool2d",
    "SurfConv2d",
    "SurfMaxPool2d",
    "__version__",
    "at_output_centers",
    "depth_to_scale",
    "reference",
    "surf_avg_pool2d",
    "surf_conv2d",
    "surf_max_pool2d",
]
