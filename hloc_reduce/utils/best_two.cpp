// The two largest dot products of each row of integers with the rows of a second matrix, or the
// largest of each row of both.
//
// Products stay in registers: those of a row of `a` with LANES rows of `b` are summed in the lanes
// of one vector and compared with the best two of each lane so far. This file includes itself once
// for each instruction set. Its functions are called by utils/best_two.py.

#ifndef LANES

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#ifndef __GNUC__
#error "This needs the vector types of GCC and Clang. Without it, NumPy computes the same."
#endif

namespace {

constexpr int ROWS = 4;  // of a at once
constexpr int32_t NOTHING = -(1 << 30);  // below every product

// With `second`, the two largest of each row of a; with `back`, the largest of each row of both.
using Search = void (*)(const int16_t* a, int64_t n, const int16_t* b, int64_t m, int64_t dim,
                        int32_t* index, int32_t* best, int32_t* second, int32_t* back);

// Each instruction set defines TARGET, an attribute of its functions; LANES, 32-bit sums in a
// vector; and GROUP numbers of type NUMBER, which `dot` multiplies in each lane by those in the
// 32 bits of `a` and adds to the sum.

#if defined(__x86_64__)

namespace vnni {
#define TARGET __attribute__((target("avx512f,avx512vnni")))
#define LANES 16
#define GROUP 2
#define NUMBER int16_t
typedef int32_t Vector __attribute__((vector_size(4 * LANES)));
TARGET inline Vector dot(Vector sum, Vector b, int32_t a) {
    return (Vector)_mm512_dpwssd_epi32((__m512i)sum, (__m512i)b, _mm512_set1_epi32(a));
}
bool is_supported() {
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vnni");
}
#include "best_two.cpp"
}  // namespace vnni

namespace avx2 {
#define TARGET __attribute__((target("avx2")))
#define LANES 8
#define GROUP 2
#define NUMBER int16_t
typedef int32_t Vector __attribute__((vector_size(4 * LANES)));
TARGET inline Vector dot(Vector sum, Vector b, int32_t a) {
    return sum + (Vector)_mm256_madd_epi16((__m256i)b, _mm256_set1_epi32(a));
}
bool is_supported() { return __builtin_cpu_supports("avx2"); }
#include "best_two.cpp"
}  // namespace avx2

#endif

namespace plain {
#define TARGET
#define LANES 4
typedef int32_t Vector __attribute__((vector_size(4 * LANES)));
#if defined(__x86_64__)
#define GROUP 2
#define NUMBER int16_t
inline Vector dot(Vector sum, Vector b, int32_t a) {
    return sum + (Vector)_mm_madd_epi16((__m128i)b, _mm_set1_epi32(a));
}
#else
#define GROUP 1
#define NUMBER int32_t
inline Vector dot(Vector sum, Vector b, int32_t a) { return sum + b * a; }
#endif
bool is_supported() { return true; }
#include "best_two.cpp"
}  // namespace plain

struct Instructions {
    const char* name;
    bool (*is_supported)();
    Search best_two, best_both;
};

const Instructions ALL[] = {  // fastest first
#if defined(__x86_64__)
    {"AVX-512 VNNI", vnni::is_supported, vnni::search<false>, vnni::search<true>},
    {"AVX2", avx2::is_supported, avx2::search<false>, avx2::search<true>},
#endif
    {"plain", plain::is_supported, plain::search<false>, plain::search<true>},
};

}  // namespace

extern "C" {

// Return the name of an instruction set, "" if this processor lacks it, null after the last.
const char* best_two_name(int instructions) {
    const int number = sizeof ALL / sizeof *ALL;
    if (instructions >= number) return nullptr;
#if defined(__x86_64__)
    __builtin_cpu_init();  // which Clang's runtime does not always do by itself
#endif
    return ALL[instructions].is_supported() ? ALL[instructions].name : "";
}

// Search for each row of a (n, dim) in the rows of b (m, dim), m > 0: the first row of b with the
// largest dot product, that product, and the second largest, INT32_MIN if m is 1. All products are
// between -2^30 and 2^30.
void best_two(int instructions, const int16_t* a, int64_t n, const int16_t* b, int64_t m,
              int64_t dim, int32_t* index, int32_t* best, int32_t* second) {
    ALL[instructions].best_two(a, n, b, m, dim, index, best, second, nullptr);
    if (m == 1) std::fill(second, second + n, INT32_MIN);
}

// Search for each row of a (n, dim), n > 0, and each row of b (m, dim), m > 0: the first row of the
// other one with the largest dot product; and that product for a.
void best_both(int instructions, const int16_t* a, int64_t n, const int16_t* b, int64_t m,
               int64_t dim, int32_t* index, int32_t* best, int32_t* back) {
    ALL[instructions].best_both(a, n, b, m, dim, index, best, nullptr, back);
}
}

#else  // included by itself, for one set of instructions

// Put groups of rows (count, dim) side by side, as many rows as there are lanes: block by block of
// rows, group by group, lane by lane. The result starts at a multiple of 64 bytes.
NUMBER* pack(const int16_t* rows, int64_t count, int64_t dim, int64_t lanes,
             std::vector<NUMBER>& memory) {
    const int64_t groups = (dim + GROUP - 1) / GROUP, blocks = (count + lanes - 1) / lanes;
    memory.resize(blocks * groups * lanes * GROUP + 64);
    NUMBER* packed = memory.data();
    while ((uintptr_t)packed % 64) ++packed;
    for (int64_t i = 0; i < count; ++i) {
        NUMBER* lane = packed + (i / lanes * groups * lanes + i % lanes) * GROUP;
        for (int64_t start = 0; start < dim; start += GROUP, lane += lanes * GROUP)
            for (int64_t d = start; d < std::min(start + GROUP, dim); ++d)
                lane[d - start] = rows[i * dim + d];
    }
    return packed;
}

template <bool BOTH>
TARGET void search(const int16_t* a, int64_t n, const int16_t* b, int64_t m, int64_t dim,
                   int32_t* index, int32_t* best, int32_t* second, int32_t* back) {
    std::vector<NUMBER> memory_a, memory_b;
    const NUMBER* packed_a = pack(a, n, dim, 1, memory_a);
    const NUMBER* packed_b = pack(b, m, dim, LANES, memory_b);
    const int64_t groups = (dim + GROUP - 1) / GROUP, blocks = (m + LANES - 1) / LANES;
    Vector missing = {};  // lanes without a row, in the last block
    for (int64_t lane = m - (blocks - 1) * LANES; lane < LANES; ++lane) missing[lane] = NOTHING;
    // of each row of b, lane by lane: the largest product so far, and its row of a
    std::vector<int32_t> of_b(BOTH ? blocks * LANES : 0, INT32_MIN), row_of_a(of_b.size());
    for (int64_t i = 0; i < n; i += ROWS) {
        const NUMBER* row[ROWS];
        Vector highest[ROWS], next[ROWS], where[ROWS];
        for (int r = 0; r < ROWS; ++r) {
            row[r] = packed_a + std::min(i + r, n - 1) * groups * GROUP;
            highest[r] = next[r] = Vector{} + INT32_MIN;
            where[r] = Vector{};
        }
        const NUMBER* side = packed_b;
        for (int64_t block = 0; block < blocks; ++block) {
            Vector sum[ROWS];
            for (int r = 0; r < ROWS; ++r) sum[r] = block + 1 < blocks ? Vector{} : missing;
            for (int64_t group = 0; group < groups; ++group, side += LANES * GROUP) {
                Vector numbers;
                std::memcpy(&numbers, side, sizeof numbers);
                for (int r = 0; r < ROWS; ++r) {
                    int32_t word;
                    std::memcpy(&word, row[r] + group * GROUP, sizeof word);
                    sum[r] = dot(sum[r], numbers, word);
                }
            }
            for (int r = 0; r < ROWS; ++r) {
                if constexpr (!BOTH) {
                    const Vector lower = sum[r] < highest[r] ? sum[r] : highest[r];
                    next[r] = lower > next[r] ? lower : next[r];
                }
                where[r] = sum[r] > highest[r] ? Vector{} + (int32_t)block : where[r];
                highest[r] = sum[r] > highest[r] ? sum[r] : highest[r];
            }
            if constexpr (BOTH) {
                Vector top, from;
                std::memcpy(&top, &of_b[block * LANES], sizeof top);
                std::memcpy(&from, &row_of_a[block * LANES], sizeof from);
                for (int r = 0; r < ROWS; ++r) {
                    from = sum[r] > top ? Vector{} + (int32_t)(i + r) : from;
                    top = sum[r] > top ? sum[r] : top;
                }
                std::memcpy(&of_b[block * LANES], &top, sizeof top);
                std::memcpy(&row_of_a[block * LANES], &from, sizeof from);
            }
        }
        int32_t lanes[ROWS][3][LANES];  // a copy: vectors that are indexed leave the registers
        for (int r = 0; r < ROWS; ++r) {
            std::memcpy(lanes[r][0], &highest[r], sizeof lanes[r][0]);
            std::memcpy(lanes[r][1], &next[r], sizeof lanes[r][1]);
            std::memcpy(lanes[r][2], &where[r], sizeof lanes[r][2]);
        }
        for (int r = 0; r < ROWS && i + r < n; ++r) {
            int64_t first = m;
            int32_t top = INT32_MIN, runner_up = INT32_MIN;
            for (int lane = 0; lane < LANES; ++lane) {
                const int32_t value = lanes[r][0][lane];
                const int64_t j = (int64_t)lanes[r][2][lane] * LANES + lane;
                runner_up = std::max({runner_up, lanes[r][1][lane], std::min(value, top)});
                if (value > top || (value == top && j < first)) top = value, first = j;
            }
            index[i + r] = (int32_t)first;
            best[i + r] = top;
            if constexpr (!BOTH) second[i + r] = runner_up;
        }
    }
    if constexpr (BOTH) std::copy_n(row_of_a.begin(), m, back);
}

#undef TARGET
#undef LANES
#undef GROUP
#undef NUMBER

#endif
