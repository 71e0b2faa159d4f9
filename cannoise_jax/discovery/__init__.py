"""Discovery: where a simulator and recordings differ, what physics was left out, the proof on new frames."""
