"""What is written of a diagnosis: the document, cards, wording, pictures, the page."""
