"""What a simulator lacks: declared, located, named, fitted, with the smallest effect that would be seen."""
