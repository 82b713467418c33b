# SPDX-License-Identifier: BSD-3-Clause
"""The program of one camera: detects roundels in its frames and publishes them over Zenoh."""
