"""Learning: datasets, trainings, calibration and scores. It makes weights and judges them; no answer needs it."""
