// Nearest neighbours of descriptors that are rounded to integers, and of signs.

#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "tensors.hpp"

namespace hlm {

// Return the sum of numbers, added in NumPy's order, so that norms are those of Python to the bit.
inline float sum(const float* numbers, std::size_t count) {
    if (count < 8) return std::accumulate(numbers, numbers + count, 0.0F);
    if (count > 128) {
        const std::size_t half = count / 2 - count / 2 % 8;
        return sum(numbers, half) + sum(numbers + half, count - half);
    }
    float parts[8] = {};
    const std::size_t whole = count - count % 8;
    for (std::size_t i = 0; i < whole; ++i) parts[i % 8] += numbers[i];
    const float total = ((parts[0] + parts[1]) + (parts[2] + parts[3])) +
                        ((parts[4] + parts[5]) + (parts[6] + parts[7]));
    return std::accumulate(numbers + whole, numbers + count, total);
}

inline float norm(const float* descriptor, std::size_t dim) {
    std::vector<float> squares(dim);
    for (std::size_t i = 0; i < dim; ++i) squares[i] = descriptor[i] * descriptor[i];
    return std::sqrt(sum(squares.data(), dim));
}

constexpr float INTEGER_SCALE = 20'000;  // the integer that stands for 1
constexpr float MAX_NORM = 1.5;          // with which products fit into 32 bits

// Round descriptors (N, dim) of unit norm to integers.
inline std::vector<std::int16_t> to_integers(const std::vector<float>& descriptors,
                                             std::size_t dim) {
    for (std::size_t i = 0; i < descriptors.size(); i += dim)
        check(norm(&descriptors[i], dim) <= MAX_NORM, "descriptors that are not of unit norm");
    std::vector<std::int16_t> found;
    for (float number : descriptors)
        found.push_back(static_cast<std::int16_t>(std::lrint(number * INTEGER_SCALE)));
    return found;
}

// The nearest descriptor.
struct Nearest {
    std::size_t row;
    std::int32_t product, second;  // the largest two

    // Tell whether the distance is at most a share of that to the second nearest.
    bool passes(float square_of_ratio) const {
        return 1 - cosine(product) <= square_of_ratio * (1 - cosine(second));
    }
    static float cosine(std::int32_t product) {
        return static_cast<float>(product) / (INTEGER_SCALE * INTEGER_SCALE);
    }
};

// Search for the nearest of some rows of descriptors (N, dim), of equal ones the first.
inline Nearest nearest(const std::int16_t* descriptor, const std::vector<std::int16_t>& others,
                       std::size_t dim, const std::vector<std::size_t>& rows) {
    constexpr std::int32_t lowest = std::numeric_limits<std::int32_t>::min();
    Nearest found{0, lowest, lowest};
    for (std::size_t row : rows) {
        const std::int16_t* other = &others[row * dim];
        std::int32_t product = 0;
        for (std::size_t i = 0; i < dim; ++i) product += descriptor[i] * other[i];
        if (product > found.product) {
            found = {row, product, found.product};
        } else {
            found.second = std::max(found.second, product);
        }
    }
    return found;
}

// Match a photo with images that show points: of each, those descriptors that are each other's
// nearest, and both nearer than `ratio` times the second nearest, unless that is 0.
//
// Descriptors are (P, dim) of points and (N, dim) of the photo; `images` have the rows of their
// points. The different pairs of rows, of the photo and of the points, are returned, sorted.
inline std::vector<std::pair<std::size_t, std::size_t>> match_images_of_points(
    const std::vector<std::int16_t>& points, const std::vector<std::int16_t>& photo,
    std::size_t dim, const std::vector<std::vector<std::size_t>>& images, double ratio) {
    const auto square = static_cast<float>(ratio * ratio);
    std::vector<std::size_t> keypoints(photo.size() / dim);
    std::iota(keypoints.begin(), keypoints.end(), std::size_t{0});
    std::vector<std::pair<std::size_t, std::size_t>> pairs;
    if (keypoints.empty()) return pairs;
    std::vector<Nearest> forward;  // of each point the nearest keypoint
    for (std::size_t i = 0; i < points.size(); i += dim)
        forward.push_back(nearest(&points[i], photo, dim, keypoints));
    for (const std::vector<std::size_t>& rows : images) {
        const bool is_tested = ratio > 0 && std::min(rows.size(), keypoints.size()) > 1;
        std::map<std::size_t, Nearest> backward;  // of a keypoint the nearest point
        for (std::size_t row : rows) {
            const std::size_t keypoint = forward[row].row;
            if (is_tested && !forward[row].passes(square)) continue;
            auto back = backward.find(keypoint);
            if (back == backward.end()) {
                const Nearest found = nearest(&photo[keypoint * dim], points, dim, rows);
                back = backward.emplace(keypoint, found).first;
            }
            if (back->second.row == row && (!is_tested || back->second.passes(square)))
                pairs.emplace_back(keypoint, row);
        }
    }
    std::sort(pairs.begin(), pairs.end());
    pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
    return pairs;
}

// A global descriptor that is compared with signs of others: bit i of these says whether number i
// of their Walsh-Hadamard transform is above 0.
class GlobalQuery {
public:
    explicit GlobalQuery(std::vector<float> descriptor) {
        std::size_t size = 1;
        while (size < descriptor.size()) size *= 2;
        descriptor.resize(size);
        for (std::size_t half = 1; half < size; half *= 2)
            for (std::size_t i = 0; i < size; ++i)
                if (!(i & half)) {
                    const float first = descriptor[i], second = descriptor[i + half];
                    descriptor[i] = first + second;
                    descriptor[i + half] = first - second;
                }
        const std::size_t signs = std::min(size, MAX_SIGNS);
        scale_ = 1 / std::sqrt(static_cast<float>(signs * size));
        descriptor.resize(signs);
        descriptor.resize((signs + 7) / 8 * 8);
        tables_.resize(descriptor.size() / 8 * 256);
        for (std::size_t i = 0; i < tables_.size(); ++i)
            for (std::size_t bit = 0; bit < 8; ++bit) {
                const float number = descriptor[i / 256 * 8 + bit];
                tables_[i] += i >> bit & 1 ? number : -number;
            }
    }
    std::size_t bytes() const { return tables_.size() / 256; }  // of signs

    // Return what a byte of signs adds to the product.
    float product(std::size_t i, unsigned byte) const { return tables_[i * 256 + byte]; }

    // Return about the cosine with a descriptor of some signs.
    float similarity(const Bytes& signs) const {
        float sum = 0;
        for (std::size_t i = 0; i < bytes(); ++i) sum += product(i, signs[i]);
        return sum * scale_;
    }

private:
    static constexpr std::size_t MAX_SIGNS = 1024;

    std::vector<float> tables_;  // (bytes, 256): what the eight signs of a byte add to the product
    float scale_;
};

}  // namespace hlm
