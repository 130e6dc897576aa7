"""svar."""
