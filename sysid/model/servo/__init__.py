"""The law of a servo that logs its duty, from position error to duty."""
