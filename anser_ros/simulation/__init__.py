"""Simulates a control unit and its world: board, tools, metal, sampling, faults and recordings."""
