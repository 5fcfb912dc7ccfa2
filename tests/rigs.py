"""Models of photos that a rig of two cameras took."""

import pycolmap


def taken_by_a_rig(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a model in which a rig took each two images, by name, at once, with a camera each."""
    made = pycolmap.Reconstruction()
    images = sorted(model.images.values(), key=lambda image: image.name)
    for start in range(0, len(images), 2):
        taken, number = images[start : start + 2], start + 1
        rig_from_world = taken[0].cam_from_world()
        rig = pycolmap.Rig(rig_id=number)
        frame = pycolmap.Frame(frame_id=number, rig_id=number)
        new = []
        for camera_id, image in enumerate(taken, number):
            values = model.cameras[image.camera_id].todict()
            camera = pycolmap.Camera({**values, "camera_id": camera_id})
            made.add_camera(camera)
            if camera_id == number:
                rig.add_ref_sensor(camera.sensor_id)
            else:
                rig.add_sensor(camera.sensor_id, image.cam_from_world() * rig_from_world.inverse())
            keypoints = [point.xy for point in image.points2D]
            ids = {"camera_id": camera_id, "image_id": image.image_id}
            new.append(pycolmap.Image(image.name, keypoints, **ids))
            new[-1].frame_id = number
            frame.add_data_id(new[-1].data_id)
        made.add_rig(rig)
        frame.rig_from_world = rig_from_world
        made.add_frame(frame)
        for image in new:
            made.add_image(image)
        made.register_frame(number)
    for point in model.points3D.values():
        made.add_point3D(point.xyz, point.track, point.color)
    return made
