# SPDX-License-Identifier: BSD-3-Clause
"""What all programs share: arrays, errors, configuration, command lines, terminals, logs, services and processes."""
