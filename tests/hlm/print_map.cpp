// Prints all that examples/cpp reads of maps, a line of JSON for each, or why one is refused:
//
//     print_map PROJECTION PHOTO MAP...
//
// PHOTO is as for hlm_match.

#include <cstdio>

#include "hlm.hpp"

template <class Number>
std::vector<Number> read(std::istream& file, std::size_t number) {
    std::vector<Number> found(number);
    file.read(reinterpret_cast<char*>(found.data()),
              static_cast<std::streamsize>(number * sizeof(Number)));
    return found;
}

template <class Numbers>
std::string listed(const Numbers& numbers) {
    std::ostringstream text;
    text.precision(17);
    for (const auto& number : numbers) text << (text.tellp() > 0 ? "," : "") << number;
    return "[" + text.str() + "]";
}

std::string listed(const std::vector<std::string>& items) {
    std::string text;
    for (const std::string& item : items) text += (text.empty() ? "" : ",") + item;
    return "[" + text + "]";
}

std::string use(const hlm::Map& map, const std::vector<float>& local,
                const std::vector<float>& global) {
    std::vector<std::size_t> rows(map.num_images()), all(map.num_points());
    std::iota(rows.begin(), rows.end(), std::size_t{0});
    std::iota(all.begin(), all.end(), std::size_t{0});
    std::vector<std::string> images, points, similar, matches;
    for (std::size_t image : rows) {
        hlm::check(map.image(map.name(image)) == image, "names are not sorted");
        const hlm::Pose pose = map.pose(image);
        const hlm::Camera camera = map.camera(image);
        images.push_back("[\"" + map.name(image) + "\"," + listed(pose.rotation) + "," +
                         listed(pose.translation) + ",\"" + camera.model + "\"," +
                         std::to_string(camera.width) + "," + std::to_string(camera.height) + "," +
                         listed(camera.parameters) + "," + listed(map.visible(image)) + "]");
    }
    for (std::size_t point : all) points.push_back(listed(map.xyz(point)));
    for (const auto& [image, similarity] : map.retrieve(global, 30))
        similar.push_back("[" + std::to_string(image) + "," + std::to_string(similarity) + "]");
    for (const auto& [keypoint, point, xyz] : map.match(local, rows))
        matches.push_back("[" + std::to_string(keypoint) + "," + std::to_string(point) + "," +
                          listed(xyz) + "]");
    return "{\"images\":" + listed(images) + ",\"points\":" + listed(points) +
           ",\"descriptors\":" + listed(map.descriptors(all)) + ",\"similar\":" + listed(similar) +
           ",\"matches\":" + listed(matches) + "}";
}

int main(int, char** argv) {
    std::ifstream file(argv[2], std::ios::binary);
    const auto sizes = read<std::uint32_t>(file, 3);
    const auto local = read<float>(file, std::size_t{sizes[0]} * sizes[1]);
    const auto global = read<float>(file, sizes[2]);
    for (char** path = argv + 3; *path; ++path) try {
            std::puts(use(hlm::Map(*path, argv[1]), local, global).c_str());
        } catch (const hlm::Error& error) {
            std::puts(error.what());
        }
}
