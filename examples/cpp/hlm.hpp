// A reader of compact maps (docs/map-format.md), for robots that extract features themselves: which
// images look like a photo, and which points match it. It needs C++17 and nothing else.
//
// Poses are camera from world, positions in the units of the map. Methods throw hlm::Error if what
// they read is broken; its one line does not name the file. Threads may share a map.

#pragma once

#include <array>
#include <utility>

#include "matching.hpp"
#include "tensors.hpp"

namespace hlm {

using Vector = std::array<double, 3>;

struct Pose {
    std::array<double, 4> rotation;  // unit quaternion x, y, z, w
    Vector translation;
};

struct Camera {
    std::string model;  // of COLMAP
    std::uint32_t width, height;
    std::vector<float> parameters;  // in COLMAP's order; the first pixel's centre is (0.5, 0.5)
};

struct Similar {
    std::size_t image;
    float similarity;  // about the cosine of the global descriptors
};

struct Match {
    std::size_t keypoint, point;
    Vector xyz;  // of the point
};

class Map {
public:
    // Open a map. Most maps of codes also need the file of their projection, which ships as
    // hloc_reduce/projections/weights/NAME.safetensors.
    explicit Map(const std::string& path, const std::string& projection = "")
        : file_(path) {
        const Json metadata = file_.metadata("map");
        const std::size_t version = metadata["version"].whole();
        if (version < VERSION)
            throw Error("its version is " + std::to_string(version) +
                        ". Renew it by python -m pipelines.localize --map " + path +
                        " --outputs renewed && python -m hloc_reduce.compact --map renewed/map" +
                        " --output renewed.hlm");
        if (version > VERSION) throw Error("its version is " + std::to_string(version));
        images_ = file_.get("images", "U8", 2);
        check(images_.shape[0] > 0 && images_.shape[1] == 32, "the size of images");
        cameras_ = file_.get("cameras", "U8", 2);
        names_ = file_.get("names", "U8", 1);
        visible_ = file_.get("visible", "U8", 1);
        center_step_ = metadata["center_step"].number();
        read_grid(metadata);
        read_storage(metadata, projection);
        retrieval_ = file_.get("retrieval", "U8", 2);
        check(retrieval_.shape[0] == num_images(), "the size of retrieval");
        matcher_ = metadata["matcher"].string();
    }

    std::size_t num_images() const { return images_.shape[0]; }
    std::size_t num_points() const { return num_points_; }
    std::size_t dim() const { return dim_; }  // numbers of a descriptor

    // Return the name of an image; they are sorted.
    std::string name(std::size_t image) const {
        check(image < num_images(), "an image that does not exist");
        return names_of_block(image / BLOCK)[image % BLOCK];
    }

    // Return the number of the image of a name.
    std::size_t image(const std::string& name) const {
        std::size_t first = 0, last = num_blocks();  // the blocks that may have it
        while (last - first > 1) {
            const std::size_t middle = (first + last) / 2;
            (name < names_of_block(middle)[0] ? last : first) = middle;
        }
        const std::vector<std::string> names = names_of_block(first);
        const auto found = std::find(names.begin(), names.end(), name);
        if (found == names.end()) throw Error("there is no image " + name);
        return first * BLOCK + static_cast<std::size_t>(found - names.begin());
    }

    Pose pose(std::size_t image) const {
        const Bytes row = images_.row(image);
        Vector part, centre;  // modified Rodrigues parameters, and the camera's position
        double square = 0;
        for (std::size_t i = 0; i < 3; ++i) {
            part[i] = row.load<std::int32_t>(4 * i) / WHOLE;
            square += part[i] * part[i];
            centre[i] = least_[i] + center_step_ * row.load<std::int32_t>(12 + 4 * i);
        }
        const double w = (1 - square) / (1 + square);
        for (double& one : part) one *= 2 / (1 + square);  // x, y, z of the quaternion
        const Vector once = cross(part, centre), twice = cross(part, once);
        Pose pose{{part[0], part[1], part[2], w}, {}};
        for (std::size_t i = 0; i < 3; ++i)
            pose.translation[i] = -(centre[i] + 2 * (w * once[i] + twice[i]));
        return pose;
    }

    Camera camera(std::size_t image) const {
        static const std::vector<std::pair<const char*, std::size_t>> models = {
            {"SIMPLE_PINHOLE", 3}, {"PINHOLE", 4}, {"SIMPLE_RADIAL", 4}, {"RADIAL", 5},
            {"OPENCV", 8}, {"OPENCV_FISHEYE", 8}, {"FULL_OPENCV", 12}, {"FOV", 5},
            {"SIMPLE_RADIAL_FISHEYE", 4}, {"RADIAL_FISHEYE", 5}, {"THIN_PRISM_FISHEYE", 12},
            {"RAD_TAN_THIN_PRISM_FISHEYE", 16}, {"SIMPLE_DIVISION", 4}, {"DIVISION", 5},
            {"SIMPLE_FISHEYE", 3}, {"FISHEYE", 4}, {"EUCM", 6}};
        const Bytes row = cameras_.row(images_.row(image).load<std::uint32_t>(24));
        const auto model = row.load<std::uint32_t>(0);
        check(model < models.size(), "a model of cameras that does not exist");
        Camera camera{models[model].first, row.load<std::uint32_t>(4), row.load<std::uint32_t>(8),
                      {}};
        for (std::size_t i = 0; i < models[model].second; ++i)
            camera.parameters.push_back(row.load<float>(12 + 4 * i));
        return camera;
    }

    // Return the points that an image shows, ascending.
    std::vector<std::size_t> visible(std::size_t image) const {
        const Bytes packed = packed_visible(image);
        std::vector<std::size_t> points;
        if (packed.size == 0) return points;
        std::size_t at = 0;
        const std::size_t head = number_in_base_128(packed, at);
        points.push_back(head / 2);
        if (head % 2) {  // a bitmap
            for (std::size_t i = 0; i < 8 * (packed.size - at); ++i)
                if (packed[at + i / 8] >> i % 8 & 1) points.push_back(points[0] + 1 + i);
        } else {
            while (at < packed.size) {
                const std::size_t difference = number_in_base_128(packed, at);
                check(difference > 0, "visible points that are not ascending");
                points.push_back(points.back() + difference);
            }
        }
        check(points.back() < num_points_, "visible points that do not exist");
        return points;
    }

    // Return the coordinates of a point.
    Vector xyz(std::size_t point) const {
        check(point < num_points_, "a point that does not exist");
        std::size_t bit = point * (bits_[0] + bits_[1] + bits_[2]);
        Vector found;
        for (std::size_t i = 0; i < 3; bit += bits_[i++]) {
            const std::uint64_t word = coordinates_.load<std::uint64_t>(bit / 8) >> bit % 8;
            const std::uint64_t mask = (std::uint64_t{1} << bits_[i]) - 1;
            found[i] = least_[i] + step_ * static_cast<double>(word & mask);
        }
        return found;
    }

    // Return the descriptors (K, dim) of points, of unit norm; or those of codes, if `unbiased`, of
    // such norms that their products estimate cosines.
    std::vector<float> descriptors(const std::vector<std::size_t>& points,
                                   bool unbiased = false) const {
        std::vector<float> found(points.size() * dim_), norms(points.size());
        for (std::size_t i = 0; i < points.size(); ++i) {
            float* descriptor = &found[i * dim_];
            const Bytes row = descriptors_.row(points[i]);
            for (std::size_t d = 0; d < dim_; ++d) descriptor[d] = decode(row, d);
            norms[i] = norm(descriptor, dim_);
            check(std::isfinite(norms[i]), "descriptors that are not finite");
            for (std::size_t d = 0; d < dim_ && !is_float(); ++d)
                descriptor[d] /= std::max(norms[i], std::numeric_limits<float>::min());
        }
        if (unbiased && code_bits_ && !points.empty()) {
            const float mean = sum(norms.data(), norms.size()) / static_cast<float>(norms.size());
            for (float& number : found) number /= std::clamp(mean, 0.75F, 1.0F);
        }
        return found;
    }

    // Return the images, at most a number, most similar to a global descriptor, the best first.
    std::vector<Similar> retrieve(const std::vector<float>& descriptor, std::size_t number) const {
        const GlobalQuery query(descriptor);
        if (query.bytes() != retrieval_.shape[1])
            throw Error("its global descriptors have another length");
        for (float one : descriptor)
            if (!std::isfinite(one)) throw Error("the global descriptor is not finite");
        std::vector<Similar> found;
        for (std::size_t image : candidates(query, number))
            if (packed_visible(image).size)
                found.push_back({image, query.similarity(retrieval_.row(image))});
        std::stable_sort(found.begin(), found.end(), [](const Similar& one, const Similar& other) {
            return one.similarity > other.similarity;
        });
        found.resize(std::min(number, found.size()));
        return found;
    }

    // Match local descriptors (N, dim) of a photo, of unit norm, with the points that some images
    // show, by the map's rule. The different matches are returned, sorted.
    std::vector<Match> match(std::vector<float> descriptors,
                             const std::vector<std::size_t>& images) const {
        static const std::map<std::string, double> ratios = {{"NN-mutual", 0.0},
                                                             {"NN-ratio", 0.8},
                                                             {"NN-ratio85", 0.85},
                                                             {"NN-ratio90", 0.9},
                                                             {"NN-ratio95", 0.95}};
        if (!ratios.count(matcher_))
            throw Error("its matcher, " + matcher_ + ", is not in this reader");
        if (descriptors.size() % dim_)
            throw Error("its descriptors have " + std::to_string(dim_) + " numbers");
        if (storage_ != "float32")
            for (float& number : descriptors) number = round_to_half(number);
        std::vector<std::vector<std::size_t>> shown;
        std::vector<std::size_t> points;
        for (std::size_t image : images) {
            shown.push_back(visible(image));
            points.insert(points.end(), shown.back().begin(), shown.back().end());
        }
        std::sort(points.begin(), points.end());
        points.erase(std::unique(points.begin(), points.end()), points.end());
        for (std::vector<std::size_t>& rows : shown)
            for (std::size_t& row : rows)  // of its point in `points`
                row = static_cast<std::size_t>(
                    std::lower_bound(points.begin(), points.end(), row) - points.begin());
        const auto described = to_integers(this->descriptors(points, true), dim_);
        const auto photo = to_integers(descriptors, dim_);
        const double ratio = ratios.at(matcher_);
        std::vector<Match> found;
        for (auto [keypoint, row] : match_images_of_points(described, photo, dim_, shown, ratio))
            found.push_back({keypoint, points[row], xyz(points[row])});
        return found;
    }

private:
    static constexpr std::size_t VERSION = 4, BLOCK = 16, LEAST = 500, CANDIDATES = 10;
    static constexpr double WHOLE = 2147483647;  // what stands for 1 in rotations

    static Vector cross(const Vector& a, const Vector& b) {
        return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
    }

    void read_grid(const Json& metadata) {
        num_points_ = metadata["points"].whole();
        step_ = metadata["step"].number();
        coordinates_ = file_.get("coordinates", "U8", 1);
        const auto &least = metadata["least"].array(), &bits = metadata["bits"].array();
        check(least.size() == 3 && bits.size() == 3, "least or bits");
        for (std::size_t i = 0; i < 3; ++i) {
            least_[i] = least[i].number();
            bits_[i] = bits[i].whole();
            check(0 < bits_[i] && bits_[i] <= 32, "bits");
            check(std::isfinite(least_[i] + step_ * 0x1p32 + center_step_ * 0x1p32),
                  "positions that are not finite");
        }
        const std::size_t size = bits_[0] + bits_[1] + bits_[2];
        check(0 < num_points_ && num_points_ <= 8 * coordinates_.size &&
                  coordinates_.size == (num_points_ * size + 7) / 8 + 8,
              "the size of coordinates");
    }

    void read_storage(const Json& metadata, const std::string& projection) {
        storage_ = metadata["storage"].string();
        const std::string type = storage_ == "float16" ? "F16" : is_float() ? "F32" : "U8";
        descriptors_ = file_.get("descriptors", type, 2);
        dim_ = descriptors_.shape[1];
        if (storage_ == "uint8") {
            check(metadata["scale"].array().size() == 2, "scale");
            scale_ = static_cast<float>(metadata["scale"].array()[0].number());
            offset_ = static_cast<float>(metadata["scale"].array()[1].number());
            check(std::isfinite(255 * scale_ + offset_), "a scale that is not finite");
        } else if (!is_float()) {
            check(storage_ == "uint1" || storage_ == "uint2" || storage_ == "uint4", "storage");
            code_bits_ = static_cast<std::size_t>(storage_[4] - '0');
            read_levels(metadata, projection);
        }
        check(descriptors_.shape[0] == num_points_ && dim_ > 0, "descriptors");
    }

    // Read the numbers that codes stand for: those of the map, or else of its projection.
    void read_levels(const Json& metadata, const std::string& projection) {
        if (file_.has("levels")) return read_levels(file_, "levels");
        const std::string feature = metadata["conf"]["model"]["projection"].string();
        const std::size_t prefix = std::min(feature.find('@'), feature.size());
        const std::string name = feature.substr(0, prefix) + ".safetensors";
        if (projection.substr(projection.find_last_of("/\\") + 1) != name)
            throw Error("it needs the file of its projection, " + name);
        try {
            read_levels(TensorFile(projection), "levels." + storage_ + feature.substr(prefix));
        } catch (const Error& error) {
            throw Error(projection + ": " + error.what());
        }
    }
    void read_levels(const TensorFile& file, const std::string& name) {
        const Tensor found = file.get(name, "F16", 2);
        dim_ = found.shape[0];
        check(found.shape[1] == std::size_t{1} << code_bits_ &&
                  descriptors_.shape[1] == (dim_ * code_bits_ + 7) / 8,
              "the size of levels");
        for (std::size_t i = 0; i < found.size; i += 2) {
            levels_.push_back(from_half(found.load<std::uint16_t>(i)));
            check(std::isfinite(levels_.back()), "levels that are not finite");
        }
    }

    bool is_float() const { return storage_ == "float16" || storage_ == "float32"; }

    // Return number d of a descriptor, before it is normalized.
    float decode(const Bytes& row, std::size_t d) const {
        if (storage_ == "float16") return from_half(row.load<std::uint16_t>(2 * d));
        if (storage_ == "float32") return row.load<float>(4 * d);
        if (storage_ == "uint8") return static_cast<float>(row[d]) * scale_ + offset_;
        const std::size_t bit = d * code_bits_, levels = std::size_t{1} << code_bits_;
        return levels_[d * levels + (row[bit / 8] >> bit % 8 & (levels - 1))];
    }

    std::size_t num_blocks() const { return (num_images() + BLOCK - 1) / BLOCK; }

    // Return the names of a block. Each shares some bytes with the one before.
    std::vector<std::string> names_of_block(std::size_t block) const {
        const Bytes text = names_.part(4 * num_blocks(), names_.size);
        const std::size_t begin = names_.load<std::uint32_t>(4 * block);
        const bool is_last = block + 1 == num_blocks();
        const Bytes packed =
            text.part(begin, is_last ? text.size : names_.load<std::uint32_t>(4 * block + 4));
        std::vector<std::string> names;
        std::string name;
        for (std::size_t i = 0; i < packed.size; ++i) {
            check(packed[i] <= name.size(), "names");
            name.resize(packed[i]);
            for (++i; packed[i] != '\n'; ++i) name += static_cast<char>(packed[i]);
            names.push_back(name);
        }
        check(names.size() == std::min(BLOCK, num_images() - BLOCK * block), "the number of names");
        return names;
    }

    // Return what tells which points an image shows.
    Bytes packed_visible(std::size_t image) const {
        const std::size_t begin = image ? images_.row(image - 1).load<std::uint32_t>(28) : 0;
        return visible_.part(begin, images_.row(image).load<std::uint32_t>(28));
    }

    // Return the number that begins at a byte, and go on behind it: 7 bits a byte, the low ones
    // first, the high bit set in all but the last.
    static std::size_t number_in_base_128(const Bytes& packed, std::size_t& at) {
        std::size_t number = 0;
        for (unsigned shift = 0; shift < 35; shift += 7) {
            const unsigned byte = packed[at++];
            number |= std::size_t{byte & 127} << shift;
            if (byte < 128) return number;
        }
        throw Error("the file is broken: a number that is too long");
    }

    // Return the images that may be among a number of the most similar ones, ascending: all, or in
    // a large map those whose first signs are the most similar.
    std::vector<std::size_t> candidates(const GlobalQuery& query, std::size_t number) const {
        std::vector<std::size_t> images(num_images());
        std::iota(images.begin(), images.end(), std::size_t{0});
        if (!file_.has("coarse")) return images;
        const Tensor coarse = file_.get("coarse", "U8", 2);  // (bytes, images)
        check(coarse.shape[0] <= query.bytes() && coarse.shape[1] == num_images(), "coarse");
        std::vector<float> products(num_images());
        for (std::size_t i = 0; i < coarse.size; ++i)
            products[i % num_images()] += query.product(i / num_images(), coarse[i]);
        const std::size_t kept =
            std::min(std::max(LEAST, CANDIDATES * std::min(number, num_images())), num_images());
        const auto end = images.begin() + static_cast<std::ptrdiff_t>(kept);
        std::nth_element(images.begin(), end, images.end(), [&](std::size_t a, std::size_t b) {
            return products[a] > products[b];
        });
        std::sort(images.begin(), end);
        images.resize(kept);
        return images;
    }

    TensorFile file_;
    std::string storage_, matcher_;
    Tensor images_, cameras_, names_, visible_, coordinates_, descriptors_, retrieval_;
    Vector least_{};
    double step_ = 0, center_step_ = 0;
    std::array<std::size_t, 3> bits_{};  // of a coordinate
    std::size_t num_points_ = 0, dim_ = 0, code_bits_ = 0;
    std::vector<float> levels_;  // (dim, 2^code_bits)
    float scale_ = 1, offset_ = 0;
};

}  // namespace hlm
