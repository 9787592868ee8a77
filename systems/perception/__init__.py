"""From sensors to the state that planners use.

pinhole_camera, camera_shake, noisy_sensor: models of cameras and sensors
ball_tracker, pose_tracker: find an object in images
pose_sensor, past_state: delayed readings of an object's pose
state_estimator: the state of tip and object
"""
