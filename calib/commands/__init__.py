# SPDX-License-Identifier: BSD-3-Clause
"""`python -m calib`, one module a subcommand: its options, and what it does with them."""
