"""What `plan` says of time: nothing of what does not focus."""

from __future__ import annotations

from pathlib import Path

import blocksar

# Of a strip whose beam looks far ahead, the last of 11 blocks holds hardly any ground that is lit.
SLIVER = """
[radar]
carrier = 9.3e9
bandwidth = 80e6
range_sampling = 96e6
prf = 450.0
[track]
position = [0.0, 0.0, 1200.0]
velocity = [70.0, 0.0, 8.0]
acceleration = [-0.4, -0.9, 0.2]
[time]
pulses = 2600
[beam]
mode = "stripmap"
width_deg = 2.0
squint_deg = 58.0
[scene]
swath = [4900.0, 5150.0]
centre_yaw_deg = 30.0
reference_range = "constant"
"""


def test_a_plan_that_does_not_focus_is_not_timed(tmp_path: Path) -> None:
    """The samples of a block that folds may have no bounds: 4e14 bytes were asked for, and a traceback printed."""
    (tmp_path / "scene.toml").write_text(SLIVER)
    report = blocksar.plan(tmp_path / "scene.toml", blocks=11)
    assert report.refusal is None or "block 10" in report.refusal
    assert any("a run takes about" in line for line in report.summary) == (report.refusal is None)
