"""Images: volumes in the patient frame, labels, the template and its landmarks."""
