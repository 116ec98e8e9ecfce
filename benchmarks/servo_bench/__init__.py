"""A third generator of blind sets: one position servo with an arm on a test bench; shares no code
with the others nor with the analyser."""
