"""How fast, stage by stage: against the machine's floor, and against the straightforward implementation."""
