// Everything the kernel sources include, apart from each other.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

#include "../memory.h"
#include "../surf_conv2d.h"
#include "../surf_pool2d.h"
