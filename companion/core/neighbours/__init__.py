"""What a vehicle knows of the others: samples examined, kept as tracks, and predicted to now."""
