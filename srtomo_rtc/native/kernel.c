#include "kernel.h"

#include <string.h>

/* One source for every machine: the loader picks the widest vectors that the processor has. The file is compiled with
 * -ffp-contract=off, since a fused multiply-add keeps bits that not every machine would have. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define WIDEST __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define WIDEST
#endif

enum { LANES = 16 };

/* aligned to their elements only: a caller's memory may start anywhere */
typedef float floats __attribute__((vector_size(LANES * sizeof(float)), aligned(4), may_alias));
typedef int16_t int16s __attribute__((vector_size(LANES * sizeof(int16_t)), aligned(2), may_alias));

WIDEST void srt_accumulate(const float *tiles, size_t n_tiles, size_t n_columns, size_t first, size_t last,
                           const float *vector, float *sums)
{
    for (size_t t = 0; t < n_tiles; t++) {
        const floats *tile = (const floats *)(tiles + t * n_columns * SRT_TILE);
        floats *out = (floats *)(sums + t * SRT_TILE);
        floats a = out[0], b = out[1];
        for (size_t j = first; j < last; j++) {
            const floats *column = tile + j * (SRT_TILE / LANES);
            a += column[0] * vector[j];
            b += column[1] * vector[j];
        }
        out[0] = a, out[1] = b;
    }
}

#define CONVERTED(integers) __builtin_convertvector(integers, floats)

WIDEST void srt_accumulate_int16(const int16_t *tiles, size_t n_tiles, size_t n_columns, size_t first, size_t last,
                                 const float *vector, float *sums)
{
    for (size_t t = 0; t < n_tiles; t++) {
        const int16s *tile = (const int16s *)(tiles + t * n_columns * SRT_TILE_INT16);
        floats *out = (floats *)(sums + t * SRT_TILE_INT16);
        floats a = out[0], b = out[1], c = out[2], d = out[3];
        for (size_t j = first; j < last; j++) {
            const int16s *column = tile + j * (SRT_TILE_INT16 / LANES);
            a += CONVERTED(column[0]) * vector[j];
            b += CONVERTED(column[1]) * vector[j];
            c += CONVERTED(column[2]) * vector[j];
            d += CONVERTED(column[3]) * vector[j];
        }
        out[0] = a, out[1] = b, out[2] = c, out[3] = d;
    }
}

void srt_multiply(const srt_product *product, size_t from, size_t to)
{
    const char *tiles = (const char *)product->tiles + from * product->n_columns * SRT_COLUMN;
    size_t n = to - from, columns = product->n_columns, first = product->first, last = product->last;
    if (product->int16)
        srt_accumulate_int16((const int16_t *)tiles, n, columns, first, last, product->vector,
                             product->sums + from * SRT_TILE_INT16);
    else
        srt_accumulate((const float *)tiles, n, columns, first, last, product->vector,
                       product->sums + from * SRT_TILE);
}

WIDEST bool srt_all_finite(const float *values, size_t n)
{
    const uint32_t exponent = 0x7f800000;
    uint32_t bad = 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t bits;
        memcpy(&bits, values + i, sizeof bits);
        bad |= (bits & exponent) == exponent;
    }
    return !bad;
}

const char *srt_instructions(void)
{
#if defined(__x86_64__) && defined(__GNUC__)
    return __builtin_cpu_supports("avx512f") ? "AVX-512" : __builtin_cpu_supports("avx2") ? "AVX2" : "SSE2";
#else
    return "baseline";
#endif
}
