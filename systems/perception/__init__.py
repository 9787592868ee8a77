"""From sensors to the state that planners use.

pinhole_camera, camera_shake, noisy_sensor: cameras and sensors
ball_tracker, pose_tracker: objects in pictures
pose_sensor, past_state: poses that come as readings
state_estimator: the state of tip and object
"""
