// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <nanobind/nanobind.h>

/// Defines functions that read the columns of messages.
void bind_messages(nanobind::module_& m);
