"""A run or a campaign against the truth: errors, availability, claims, counts."""
