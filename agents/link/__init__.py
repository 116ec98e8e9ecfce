"""What travels between actors, evaluator and learner, over zenoh. Start with README.md."""
