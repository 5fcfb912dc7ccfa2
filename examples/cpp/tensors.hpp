// A file of safetensors, which a compact map is: a JSON header, and arrays, in memory by mmap.
//
// Nothing that a file says is trusted: each read checks where it ends. A file must not be cut while
// it is open.

#pragma once

#include <cstring>
#include <fstream>
#include <map>
#include <memory>

#include "json.hpp"

#if __has_include(<sys/mman.h>)
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#endif

namespace hlm {

static_assert(sizeof(std::size_t) == 8, "sizes in files have up to 64 bits");
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "Numbers in files are little-endian."
#endif

inline float from_half(std::uint16_t bits) {
    const int exponent = bits >> 10 & 31, fraction = bits & 1023;
    float size = std::ldexp(static_cast<float>(exponent ? 1024 + fraction : fraction),
                            std::max(exponent, 1) - 25);
    if (exponent == 31) size = fraction ? NAN : INFINITY;
    return bits >> 15 ? -size : size;
}

// Return the float of 16 bits that is nearest to a number, of two the even one.
inline float round_to_half(float number) {
    if (!std::isfinite(number)) return number;
    int exponent = 0;
    std::frexp(number, &exponent);
    const int step = std::max(exponent - 11, -24);
    const float rounded = std::ldexp(std::nearbyint(std::ldexp(number, -step)), step);
    return std::abs(rounded) > 65504 ? std::copysign(INFINITY, rounded) : rounded;
}

// Bytes of a file.
struct Bytes {
    const unsigned char* data = nullptr;
    std::size_t size = 0;

    // Return the number that begins at a byte.
    template <class Number>
    Number load(std::size_t begin) const {
        check(begin <= size && size - begin >= sizeof(Number), "an array that ends too early");
        Number number;
        std::memcpy(&number, data + begin, sizeof number);
        return number;
    }
    unsigned operator[](std::size_t i) const { return load<unsigned char>(i); }

    Bytes part(std::size_t begin, std::size_t end) const {
        check(begin <= end && end <= size, "a part that is outside of its array");
        return {data + begin, end - begin};
    }
};

// An array of a file.
struct Tensor : Bytes {
    std::string type;  // U8, U16, U32, I32, F16, F32 or F64
    std::vector<std::size_t> shape;

    // Return row i of a matrix.
    Bytes row(std::size_t i) const {
        check(i < shape[0], "a row that does not exist");
        const std::size_t width = size / shape[0];
        return part(i * width, (i + 1) * width);
    }
};

// Return the bytes of a file, which stay in memory as long as the pointer, null if it cannot be
// read, and their number.
inline std::shared_ptr<const unsigned char> open_file(const std::string& path, std::size_t& size) {
#if __has_include(<sys/mman.h>)
    const int file = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
    struct stat status;
    void* begin = MAP_FAILED;
    if (file >= 0 && ::fstat(file, &status) == 0 && S_ISREG(status.st_mode)) {
        size = static_cast<std::size_t>(status.st_size);
        begin = ::mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file, 0);
    }
    if (file >= 0) ::close(file);
    if (begin != MAP_FAILED)
        return {static_cast<const unsigned char*>(begin),
                [begin, size](const unsigned char*) { ::munmap(begin, size); }};
#endif
    std::ifstream stream(path, std::ios::binary);
    std::ostringstream copied;
    if (!(copied << stream.rdbuf())) return nullptr;
    const auto content = std::make_shared<const std::string>(copied.str());
    size = content->size();
    return {content, reinterpret_cast<const unsigned char*>(content->data())};
}

class TensorFile {
public:
    // Open a file: only its header is read.
    explicit TensorFile(const std::string& path) {
        Bytes all;
        content_ = open_file(path, all.size);
        if (!content_) throw Error("the file cannot be read");
        all.data = content_.get();
        const auto size = all.load<std::uint64_t>(0);
        check(0 < size && size <= MAX_HEADER && size <= all.size - 8, "a header of another size");
        const Bytes text = all.part(8, 8 + size), rest = all.part(8 + size, all.size);
        const Json header(std::string(text.data, text.data + text.size));
        for (std::size_t i = 0; i < header.keys().size(); ++i) {
            const std::string& name = header.keys()[i];
            const Json& entry = header.values()[i];
            if (name == "__metadata__") {
                metadata_ = std::make_shared<const Json>(entry);
                continue;
            }
            const std::vector<Json>& offsets = entry["data_offsets"].array();
            check(offsets.size() == 2, "offsets of ", name);
            Tensor tensor{rest.part(offsets[0].whole(), offsets[1].whole()),
                          entry["dtype"].string(), {}};
            std::size_t bytes = size_of(tensor.type);
            for (const Json& side : entry["shape"].array()) {
                const std::size_t length = side.whole();
                check(length == 0 || bytes <= tensor.size / length, "the shape of ", name);
                bytes *= length;
                tensor.shape.push_back(length);
            }
            check(bytes == tensor.size, "the shape of ", name);
            tensors_[name] = tensor;
        }
    }

    // Return the JSON in an entry of the metadata.
    Json metadata(const std::string& key) const {
        check(metadata_ != nullptr, "no metadata");
        return Json((*metadata_)[key].string());
    }
    bool has(const std::string& name) const { return tensors_.count(name) > 0; }

    // Return an array of a type and a number of dimensions.
    Tensor get(const std::string& name, const std::string& type, std::size_t dimensions) const {
        check(has(name), "no ", name);
        const Tensor& found = tensors_.at(name);
        check(found.type == type && found.shape.size() == dimensions, "the type of ", name);
        return found;
    }

private:
    static constexpr std::uint64_t MAX_HEADER = 100'000'000;  // bytes

    static std::size_t size_of(const std::string& type) {
        static const std::map<std::string, std::size_t> sizes = {
            {"U8", 1}, {"U16", 2}, {"F16", 2}, {"U32", 4}, {"I32", 4}, {"F32", 4}, {"F64", 8}};
        const auto found = sizes.find(type);
        check(found != sizes.end(), "an array of another type");
        return found->second;
    }

    std::shared_ptr<const unsigned char> content_;
    std::shared_ptr<const Json> metadata_;
    std::map<std::string, Tensor> tensors_;
};

}  // namespace hlm
