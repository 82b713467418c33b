# SPDX-License-Identifier: BSD-3-Clause
"""One a camera: frame to roundels to Zenoh."""
