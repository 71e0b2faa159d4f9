"""The paper's system as printed, at full width, on SIDD Medium. Needs a GPU and days.

    bin/train --workdir runs/paper --config configs/paper.py --config.data.path=/path/to/SIDD_Medium_Raw

Cost: 300 epochs of 500 000 patches, batch 64, is 2.34 million steps; the paper gives about 3 days on one
GTX 1080 Ti. Expected: the paper reports a KL of 0.00159, users of its released
checkpoints measure 0.117; this config has not been run to its end. For the repaired networks:
--config.literal=False with the default's optimiser and critic fields. Patches go to
WORKDIR/patches once (69 GB).
"""

from pathlib import Path
from runpy import run_path

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder


def get_config() -> ConfigDict:
    """The default's fields with the paper's values."""
    config = run_path(str(Path(__file__).with_name("default.py")))["get_config"]()
    config.update(
        {
            "steps": 300 * 500_000 // 64,
            "batch_size": 64,
            "patch": 64,
            "reference": 64,
            "width": 1.0,
            "literal": False,
            "paper": True,
            "level": "given",
            "clip": False,
            "critic_updates": 1,
            "critic_condition": "none",
            "ema": 0.0,
            "log_every": 100,
            "evaluate_every": 20_000,
            "validation_patches": 2000,
            "references": 1,
            "checkpoint_every": 2000,
        }
    )
    config.networks = ConfigDict({"generator": {}, "encoder": {}, "critic": {}})
    config.loss.update(
        {
            "slope": 1.0,
            "feature_matching": 1.0,
            "feature_target": "clean",
            "adversarial": 1.0,
            "statistics": 0.0,
            "quantiles": 0.0,
            "spectra": 0.0,
            "physics": 0.0,
            "triplet": 0.5,
            "triplets": "drawn",
        }
    )
    config.optimiser.update(
        {
            "generator_rate": 2e-4,
            "encoder_rate": 2e-4,
            "critic_rate": 2e-4,
            "schedule": "constant",
            "warmup": 0,
        }
    )
    config.data = ConfigDict(
        {
            "source": "sidd",
            "path": placeholder(str),
            "seed": 0,
            "train_patches": 500_000,  # paper; those of the validation scene among them
            "test_patches": 150_000,  # paper
            "test_scenes": ("001", "002", "008"),  # paper
            "validation_scene": "010",
            "held_out_patches": 4000,
            "calibration_patches": 4000,
        }
    )
    return config
