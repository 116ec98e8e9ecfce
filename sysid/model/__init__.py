"""The declared model: reduction to one joint, compiled simulation; the extended model by MuJoCo."""
