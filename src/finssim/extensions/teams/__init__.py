"""Teams: tasks of several vehicles, and what they communicate."""
