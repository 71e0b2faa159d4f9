"""The default with tiny networks and hardly any data: every part of training, in seconds.

bin/train --workdir runs/ci --config configs/ci.py
"""

from pathlib import Path
from runpy import run_path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """As the default, smaller."""
    config = run_path(str(Path(__file__).with_name("default.py")))["get_config"]()
    config.update(
        {
            "steps": 6,
            "batch_size": 4,
            "patch": 32,
            "reference": 32,
            "width": 1 / 64,
            "log_every": 1,
            "evaluate_every": 3,
            "validation_patches": 10,
            "references": 2,
            "checkpoint_every": 3,
        }
    )
    config.networks.generator = ConfigDict({"hidden": 4})
    config.networks.encoder = ConfigDict({"hidden": 8})
    config.networks.critic = ConfigDict({"hidden": 4})
    config.optimiser.warmup = 2
    config.loss.update({"adversarial": 1.0, "triplet": 0.5})  # the critic and the triplet too
    config.compiler = ConfigDict({"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})
    config.data.update(
        {
            "cameras": 8,
            "references": 2,
            "validation_cameras": 4,
            "calibration_scenes": 5,
            "scenes": 5,
            "validation_scenes": 3,
            "test_scenes": 3,
            "per_scene": 1,
            "held_out_per_scene": 1,
        }
    )
    return config
