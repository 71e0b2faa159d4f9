"""The paper's system at full width on the built-in virtual cameras: tries an accelerator where SIDD is not.

    bin/train --workdir runs/paper_virtual --config configs/paper_virtual.py

Cost: 20 minutes on an H100 once it is compiled, days on CPU cores. Expected: finite losses that fall; the
networks as printed need far more steps than this before their noise is as weak as a camera's.
"""

from pathlib import Path
from runpy import run_path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """The paper's fields, with the default's virtual cameras in the place of SIDD."""
    folder = Path(__file__).parent
    config = run_path(str(folder / "paper.py"))["get_config"]()
    config.data = run_path(str(folder / "default.py"))["get_config"]().data
    config.data.source = "virtual"
    config.update({"steps": 60_000, "log_every": 10, "evaluate_every": 20_000})
    return config
