"""Long studies whose tables the README quotes; each is a command."""
