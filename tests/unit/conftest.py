"""Unit tests of studies borrow the installer of the example package from lockstep."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "lockstep"))
