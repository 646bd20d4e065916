"""What is watched along a run, and what amplitudes and peak times say."""
