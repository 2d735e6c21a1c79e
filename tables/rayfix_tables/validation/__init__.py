"""What is right and wrong with settings and documents, in messages that name the remedy."""
