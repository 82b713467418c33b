// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <nanobind/nanobind.h>

/// Adds `Lens` to the module.
void bind_lens(nanobind::module_& m);
