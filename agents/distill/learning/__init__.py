"""The learner's side of a distillation: the student, its losses and updates, stage by stage."""
