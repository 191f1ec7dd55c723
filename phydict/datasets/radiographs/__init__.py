"""Measured X-rays: images, DICOM, descriptions."""
