"""Image processing: checks, noise, corners, sub-pixel patches, and their registration in other images.

`images` checks images and their masks, and `frozen` finds cameras that repeat an image. `image_noise` measures the
noise, and `corners` finds corners above it. `patches` and `sampling` cut patches out of images, at any place and
deformed; `alignment` and `lucas_kanade` find them in another image.
"""
