// The two largest dot products of each row of integers with the rows of a second matrix, or the
// largest of each row of both.
//
// Products stay in registers: those of a row of `a` with LANES rows of `b` are summed in the lanes
// of one vector and compared with the best two of each lane so far. This file includes itself once
// for each instruction set. Its functions are called by utils/best_two.py.
//
// GCC and Clang have vector types, and functions for other instruction sets than the rest of the
// file. Other compilers, such as MSVC, have intrinsics for x86-64; to test that code with GCC:
// -DWITHOUT_VECTOR_TYPES -mavx2

#ifndef LANES

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>

#if defined(__x86_64__) || defined(_M_X64)
#define X86_64
#include <immintrin.h>
#endif

#if !defined(__GNUC__) && !defined(__clang__) && !defined(WITHOUT_VECTOR_TYPES)
#define WITHOUT_VECTOR_TYPES
#endif
#if defined(WITHOUT_VECTOR_TYPES) && !defined(X86_64)
#error "This compiler has no vector types. Without this file, NumPy computes the same."
#endif
#if defined(_MSC_VER) && !defined(__clang__)
#include <intrin.h>
#endif

namespace {

constexpr int ROWS = 4;  // of a at once
constexpr int32_t NOTHING = -(1 << 30);  // below every product

// With `second`, the two largest of each row of a; with `back`, the largest of each row of both.
using Search = void (*)(const int16_t* a, int64_t n, const int16_t* b, int64_t m, int64_t dim,
                        int32_t* index, int32_t* best, int32_t* second, int32_t* back);

// Numbers that are not initialized. A std::vector needs a library that Windows may lack.
template <class Number>
std::unique_ptr<Number[]> allocate(int64_t count) {
    return std::unique_ptr<Number[]>(new Number[count]);
}

// Each instruction set defines TARGET, an attribute of its functions; LANES, 32-bit sums in a
// vector; and GROUP numbers of type NUMBER, which `dot` multiplies in each lane by those in the
// 32 bits of `a` and adds to the sum.

#if defined(WITHOUT_VECTOR_TYPES)

#if defined(_MSC_VER) && !defined(__clang__)
// Whether the processor has AVX2, and the system keeps its registers.
bool has_avx2() {
    int words[4];
    __cpuid(words, 0);
    if (words[0] < 7) return false;
    __cpuid(words, 1);
    const int osxsave_and_avx = 1 << 27 | 1 << 28;
    if ((words[2] & osxsave_and_avx) != osxsave_and_avx || (_xgetbv(0) & 6) != 6) return false;
    __cpuidex(words, 7, 0);
    return words[1] >> 5 & 1;
}
#else
bool has_avx2() { return __builtin_cpu_supports("avx2"); }
#endif

#define TARGET
#define GROUP 2
#define NUMBER int16_t
#define LANES 8
namespace avx2 {
typedef __m256i Vector;
inline Vector filled(int32_t value) { return _mm256_set1_epi32(value); }
inline Vector dot(Vector sum, Vector b, int32_t a) {
    return _mm256_add_epi32(sum, _mm256_madd_epi16(b, _mm256_set1_epi32(a)));
}
inline Vector larger(Vector a, Vector b) { return _mm256_max_epi32(a, b); }
inline Vector smaller(Vector a, Vector b) { return _mm256_min_epi32(a, b); }
// x where a > b, else y
inline Vector where_larger(Vector a, Vector b, Vector x, Vector y) {
    return _mm256_blendv_epi8(y, x, _mm256_cmpgt_epi32(a, b));
}
bool is_supported() { return has_avx2(); }
#include "best_two.cpp"
}  // namespace avx2

#define TARGET
#define GROUP 2
#define NUMBER int16_t
#define LANES 4
namespace plain {
typedef __m128i Vector;
inline Vector filled(int32_t value) { return _mm_set1_epi32(value); }
inline Vector dot(Vector sum, Vector b, int32_t a) {
    return _mm_add_epi32(sum, _mm_madd_epi16(b, _mm_set1_epi32(a)));
}
inline Vector where_larger(Vector a, Vector b, Vector x, Vector y) {
    const __m128i is_larger = _mm_cmpgt_epi32(a, b);
    return _mm_or_si128(_mm_and_si128(is_larger, x), _mm_andnot_si128(is_larger, y));
}
inline Vector larger(Vector a, Vector b) { return where_larger(a, b, a, b); }
inline Vector smaller(Vector a, Vector b) { return where_larger(a, b, b, a); }
bool is_supported() { return true; }
#include "best_two.cpp"
}  // namespace plain

#else

#if defined(X86_64)

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
#if defined(X86_64)
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

#endif

struct Instructions {
    const char* name;
    bool (*is_supported)();
    Search best_two, best_both;
};

const Instructions ALL[] = {  // fastest first
#if defined(X86_64)
#if !defined(WITHOUT_VECTOR_TYPES)
    {"AVX-512 VNNI", vnni::is_supported, vnni::search<false>, vnni::search<true>},
#endif
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
#if defined(X86_64) && (defined(__GNUC__) || defined(__clang__))
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

#if !defined(WITHOUT_VECTOR_TYPES)
TARGET inline Vector filled(int32_t value) { return Vector{} + value; }
TARGET inline Vector larger(Vector a, Vector b) { return a > b ? a : b; }
TARGET inline Vector smaller(Vector a, Vector b) { return a < b ? a : b; }
// x where a > b, else y
TARGET inline Vector where_larger(Vector a, Vector b, Vector x, Vector y) {
    return a > b ? x : y;
}
#endif

// Put groups of rows (count, dim) side by side, as many rows as there are lanes: block by block of
// rows, group by group, lane by lane. The result starts at a multiple of 64 bytes.
NUMBER* pack(const int16_t* rows, int64_t count, int64_t dim, int64_t lanes,
             std::unique_ptr<NUMBER[]>& memory) {
    const int64_t groups = (dim + GROUP - 1) / GROUP, blocks = (count + lanes - 1) / lanes;
    const int64_t size = blocks * groups * lanes * GROUP;
    memory = allocate<NUMBER>(size + 64);
    NUMBER* packed = memory.get();
    while ((uintptr_t)packed % 64) ++packed;
    std::fill(packed, packed + size, (NUMBER)0);
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
    std::unique_ptr<NUMBER[]> memory_a, memory_b;
    const NUMBER* packed_a = pack(a, n, dim, 1, memory_a);
    const NUMBER* packed_b = pack(b, m, dim, LANES, memory_b);
    const int64_t groups = (dim + GROUP - 1) / GROUP, blocks = (m + LANES - 1) / LANES;
    int32_t without_row[LANES] = {};  // in the last block
    for (int64_t lane = m - (blocks - 1) * LANES; lane < LANES; ++lane) without_row[lane] = NOTHING;
    Vector missing;
    std::memcpy(&missing, without_row, sizeof missing);
    // of each row of b, lane by lane: the largest product so far, and its row of a
    const int64_t size = BOTH ? blocks * LANES : 0;
    const auto of_b = allocate<int32_t>(size), row_of_a = allocate<int32_t>(size);
    std::fill(of_b.get(), of_b.get() + size, INT32_MIN);
    std::fill(row_of_a.get(), row_of_a.get() + size, 0);
    for (int64_t i = 0; i < n; i += ROWS) {
        const NUMBER* row[ROWS];
        Vector highest[ROWS], next[ROWS], where[ROWS];
        for (int r = 0; r < ROWS; ++r) {
            row[r] = packed_a + std::min(i + r, n - 1) * groups * GROUP;
            highest[r] = next[r] = filled(INT32_MIN);
            where[r] = filled(0);
        }
        const NUMBER* side = packed_b;
        for (int64_t block = 0; block < blocks; ++block) {
            Vector sum[ROWS];
            for (int r = 0; r < ROWS; ++r) sum[r] = block + 1 < blocks ? filled(0) : missing;
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
                if constexpr (!BOTH) next[r] = larger(smaller(sum[r], highest[r]), next[r]);
                where[r] = where_larger(sum[r], highest[r], filled((int32_t)block), where[r]);
                highest[r] = larger(sum[r], highest[r]);
            }
            if constexpr (BOTH) {
                Vector top, from;
                std::memcpy(&top, &of_b[block * LANES], sizeof top);
                std::memcpy(&from, &row_of_a[block * LANES], sizeof from);
                for (int r = 0; r < ROWS; ++r) {
                    from = where_larger(sum[r], top, filled((int32_t)(i + r)), from);
                    top = larger(sum[r], top);
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
    if constexpr (BOTH) std::copy_n(row_of_a.get(), m, back);
}

#undef TARGET
#undef LANES
#undef GROUP
#undef NUMBER

#endif
