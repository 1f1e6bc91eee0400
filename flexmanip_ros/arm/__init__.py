"""The mechanics of the arm: equations of motion, linearization, natural modes, capture."""
