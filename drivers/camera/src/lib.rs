//! Long-exposure camera: frames, stamps and exposure settings.
