"""Runs of many steps: the loop, events, checkpoints, interruptions."""
