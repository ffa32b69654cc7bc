// Targets of the picture loss as Python gives them.
#pragma once

#include "bind.hpp"
#include "splats/image_loss.hpp"

namespace rf3dgs {

// Shapes of a target, its weight and its statistics; they must fit.
inline LossTarget target_of(const In<-1, -1, -1>& picture, const std::optional<In<-1, -1>>& weight,
                     const std::optional<In<2, -1, -1>>& statistics) {
  const size_t height = picture.shape(0), width = picture.shape(1), channels = picture.shape(2);
  const size_t stride = loss_stride(static_cast<int>(width), static_cast<int>(channels));
  require(height > 0 && width > 0 && channels > 0 &&
              (!weight || (weight->shape(0) == height && weight->shape(1) == width)) &&
              (!statistics || (statistics->shape(1) == height && statistics->shape(2) == stride)),
          "a target, its weight and its statistics do not have one shape");
  const float* mean = data_or_null(statistics);
  return {picture.data(), data_or_null(weight), mean, mean == nullptr ? nullptr : mean + height * stride,
          static_cast<int>(height), static_cast<int>(width), static_cast<int>(channels)};
}

inline bool fits(const LossTarget& target, const auto& picture) {
  return picture.shape(0) == static_cast<size_t>(target.height) && picture.shape(1) == static_cast<size_t>(target.width) &&
         picture.shape(2) == static_cast<size_t>(target.channels);
}

}  // namespace rf3dgs
