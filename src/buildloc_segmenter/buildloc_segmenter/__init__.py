"""Buildings in an image: keyframe policy, ONNX inference, mask clean-up."""
