"""Tests with real processes borrow the inputs of the fuzz in lockstep."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "lockstep"))
