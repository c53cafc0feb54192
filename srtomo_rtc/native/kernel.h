/* Matrix-vector products by tiles of rows, in an order that no machine and no packet changes. */
#ifndef SRTOMO_KERNEL_H
#define SRTOMO_KERNEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Rows whose sums stay in registers while columns go by: 128 bytes of a column, which is two cache lines. */
enum { SRT_TILE = 32, SRT_TILE_INT16 = 64, SRT_COLUMN = 128 };

/* sums[i] += tiles[i, first] * vector[first] + ... + tiles[i, last - 1] * vector[last - 1]: column after column, every
 * product and every sum rounded to float32. Whatever a product is cut into, and on whatever machine, its bits stay.
 *
 * tiles: (n_tiles, n_columns, SRT_TILE); vector: (n_columns); sums: (n_tiles * SRT_TILE). */
void srt_accumulate(const float *tiles, size_t n_tiles, size_t n_columns, size_t first, size_t last,
                    const float *vector, float *sums);

/* The same of 16-bit integers, in tiles of SRT_TILE_INT16; the caller applies the rows' scales to the sums. */
void srt_accumulate_int16(const int16_t *tiles, size_t n_tiles, size_t n_columns, size_t first, size_t last,
                          const float *vector, float *sums);

/* One of the two: sums += tiles . vector over columns first .. last - 1. */
typedef struct {
    const void *tiles; /* (n_tiles, n_columns, SRT_COLUMN bytes) */
    size_t n_tiles, n_columns, first, last;
    const float *vector;
    float *sums;
    bool int16;
} srt_product;

/* The part of a product that tiles from .. to - 1 make. */
void srt_multiply(const srt_product *product, size_t from, size_t to);

/* Whether no value is NaN or infinite. */
bool srt_all_finite(const float *values, size_t n);

/* The instruction set that the products run with here; the bits do not depend on it. */
const char *srt_instructions(void);

#endif
