"""Fit registration, lever arm, mount and clocks of two streams of poses, jointly."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
