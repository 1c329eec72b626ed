"""The `rtugate` command, with faults to order: see ``faults``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from gateway.cli import main
from tests.hanging.faults import ORDER, arm

arm(Path(os.environ[ORDER]))
sys.exit(main())
