"""The loop of joint positions, without a policy: excite, identify, simulate, compare."""
