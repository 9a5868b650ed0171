"""Speed, stage by stage: against the machine's floor (roofline), and against the straightforward implementation."""
