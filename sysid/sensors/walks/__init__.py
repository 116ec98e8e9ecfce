"""What only walking shows: recorded walks beside the same commands in the model."""
