# SPDX-License-Identifier: BSD-3-Clause
"""knows lenses and where cameras stand."""
