"""Chest CTs: files, preparation, augmentation."""
