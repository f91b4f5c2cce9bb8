// Which depths are measurements: the one rule of the kernels that read depth.
#pragma once

#include <limits>

namespace surfconv::cpu {

// Positive and finite. Both sides are always compared, so that loops over it vectorise.
template <class T>
inline bool is_valid_depth(T depth) {
  return (depth > 0) & (depth <= std::numeric_limits<T>::max());
}

}  // namespace surfconv::cpu
