"""Dural septa as triangle sheets: from the template, from a person, from files; their fit to a brain."""
