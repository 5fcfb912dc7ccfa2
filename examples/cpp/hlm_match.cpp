// How a robot finds what to estimate its pose from:
//
//     cmake -B build && cmake --build build
//     build/hlm_match place.hlm photo.bin [PROJECTION.safetensors]
//
// photo.bin has what the robot computed from a photo, little-endian: N, D and G, uint32; N local
// descriptors of D numbers, float32, of unit norm; and a global descriptor of G numbers, float32,
// which docs/map-format.md tells how to compute from the local ones. Most maps of codes need the
// file of their projection.
//
// It prints the most similar images, and the points that match keypoints of the photo: give these,
// with the pixels of the keypoints and the camera's intrinsics, to an estimator of poses (PnP and
// RANSAC), such as PoseLib's or OpenCV's.

#include <cstdio>

#include "hlm.hpp"

template <class Number>
std::vector<Number> read(std::istream& file, std::size_t number) {
    std::vector<Number> found(number);
    file.read(reinterpret_cast<char*>(found.data()),
              static_cast<std::streamsize>(number * sizeof(Number)));
    if (!file) throw hlm::Error("the features of the photo end too early");
    return found;
}

int main(int argc, char** argv) try {
    if (argc < 3) throw hlm::Error("usage: hlm_match MAP PHOTO [PROJECTION]");
    std::ifstream file(argv[2], std::ios::binary);
    const auto sizes = read<std::uint32_t>(file, 3);
    const auto local = read<float>(file, std::size_t{sizes[0]} * sizes[1]);
    const auto global = read<float>(file, sizes[2]);

    const hlm::Map map(argv[1], argc > 3 ? argv[3] : "");
    std::vector<std::size_t> images;
    for (const auto& [image, similarity] : map.retrieve(global, 50)) {
        std::printf("%.3f %s\n", similarity, map.name(image).c_str());
        images.push_back(image);
    }
    std::printf("keypoint point x y z\n");
    for (const auto& [keypoint, point, xyz] : map.match(local, images))
        std::printf("%zu %zu %.9g %.9g %.9g\n", keypoint, point, xyz[0], xyz[1], xyz[2]);
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", argc > 1 ? argv[1] : "hlm_match", error.what());
    return 1;
}
