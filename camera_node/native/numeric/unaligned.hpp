// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <bit>
#include <cstddef>
#include <cstring>

namespace roundel {

static_assert(std::endian::native == std::endian::little, "columns of messages are little-endian");

/// The number `k` of the bytes of a column of a message, which have no alignment.
template <class T>
T number_at(const char* column, size_t k) {
    T value;
    std::memcpy(&value, column + k * sizeof(T), sizeof(T));
    return value;
}

}  // namespace roundel
