/* What all parts of the decoder core share: types, status codes, limits, tables and memory.

   Names and section numbers are those of spec/kpc-format.md. A test holds limits and tables equal to those of the
   Python packages. */

#ifndef KPC_CORE_H
#define KPC_CORE_H

#include <stdint.h>

typedef uint8_t u8;
typedef uint16_t u16;
typedef uint32_t u32;
typedef uint64_t u64;
typedef int8_t i8;
typedef int16_t i16;
typedef int32_t i32;
typedef int64_t i64;

#define EXPORT(name) __attribute__((export_name(#name)))
#define INLINE static inline __attribute__((always_inline))

/* What the exported functions return. The host makes messages of them. */
typedef enum {
    OK = 0,
    NO_MEMORY = 1,           /* the host's limit, or 4 GiB, does not hold what decoding takes */
    BAD_ARGUMENT = 2,        /* a size is 0 or beyond the limits below, or a codec unknown */
    CUT_WITHIN_WORDS = 3,    /* 5.1 */
    STATE_TOO_SMALL = 4,     /* 5.1 */
    WORDS_DO_NOT_END = 5,    /* 5.1 */
    NO_IMPLIED_MAP = 6,      /* 7.2: the map follows from an occupancy grid that the host did not give */
    RAW_MAP_MODE = 7,        /* 7.3 */
    RAW_MAP_SHORT = 8,       /* 7.3 */
    RAW_MAP_BITS = 9,        /* 7.3 */
    RAW_LENGTH = 10,         /* 7.3 */
    PREDICTIVE_FLAGS = 11,   /* 7.4 */
    PREDICTIVE_WEIGHTS = 12, /* 7.4 */
    SYMBOL_RANGE = 13,       /* 7.4 */
    TRANSFORM_FLAGS = 14,    /* 7.5 */
    TRANSFORM_SIDE = 15,     /* 7.5 */
    MOTION_RANGE = 16,       /* 8.1 */
    WEIGHTS_EXPONENT = 17,   /* 8.3 */
    WEIGHTS_RANGE = 18,      /* 8.3 */
    CONTENT_LENGTH = 19,     /* 8: raw_length is not what the sizes imply, or a head is cut off */
    POSES_CUT = 20,          /* 8.4 */
    POSES_COUNT = 21,        /* 8.4 */
    POSES_HEAD = 22,         /* 8.4 */
    POSES_LENGTH = 23,       /* 8.4 */
    POSES_RANGE = 24,        /* 8.4 */
} Status;

/* 4.4 */
enum { CODEC_RAW = 0, CODEC_ZSTD = 1, CODEC_PREDICTIVE = 2, CODEC_TRANSFORM = 3 };

/* 11.1 */
#define CHANNEL_LIMIT 256
#define AXIS_LIMIT 16384
#define MOTION_LIMIT 256
#define HIDDEN_LIMIT 256
#define CAMERA_LIMIT 4096
#define SCALE_LIMIT 16

/* 5.1 to 5.3 */
#define LOWEST_STATE 65536
#define EVEN_PROBABILITY 32768
#define ADAPTATION_LIMIT 120

/* 7.2 */
enum { ALL_CODED = 0, STORED = 1, IMPLIED = 2 };
#define MAP_CONTEXTS 1024

/* 7.5: OFFSET_SCALE, FREQUENCY_SCALE of N = 4, 8 and 16, COSINE */
static const i32 OFFSET_SCALE[8] = {181, 128, 91, 64, 45, 32, 23, 16};
static const i32 FREQUENCY_SCALE[3][16] = {
    {52, 55, 64, 80},
    {52, 53, 55, 59, 64, 71, 80, 87},
    {52, 52, 53, 54, 55, 57, 59, 61, 64, 67, 71, 75, 80, 84, 87, 90},
};
static const i32 COSINE[17] = {181, 180, 178, 173, 167, 160, 151, 140, 128, 115, 101, 85, 69, 53, 35, 18, 0};

/* 7.5, initial models: level_model number 0, number 1 and numbers 2 to 5; of frequency_class 8; sign_model */
#define INITIAL_COUNT 8
static const u8 LEVEL_PROBABILITY[3][16] = {
    {27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248},
    {19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244},
    {110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243},
};
static const u8 MEAN_PROBABILITY[3] = {243, 210, 220};
static const u8 SIGN_PROBABILITY[20] = {134, 135, 138, 141, 152, 159, 164, 170, 178, 184,
                                        190, 197, 205, 212, 218, 224, 229, 234, 239, 244};

INLINE i32 min(i32 a, i32 b) { return a < b ? a : b; }
INLINE i32 max(i32 a, i32 b) { return a > b ? a : b; }
INLINE i32 clamp(i32 a, i32 low, i32 high) { return min(max(a, low), high); }
INLINE i32 magnitude(i32 a) { return a < 0 ? -a : a; }
INLINE u32 load_u16(const u8 *at) { return at[0] | (u32)at[1] << 8; }
INLINE u32 load_u32(const u8 *at) { return load_u16(at) | load_u16(at + 2) << 16; }
INLINE void store_u16(u8 *at, u32 value) { at[0] = (u8)value, at[1] = (u8)(value >> 8); }
INLINE void fill(void *at, u8 value, u32 length) { __builtin_memset(at, value, length); }
INLINE void copy(void *to, const void *from, u32 length) { __builtin_memcpy(to, from, length); }

/* Memory for the length of one call: `mark`, then `take` zeroed bytes, and `release` the mark. `take` returns null where
   the limit of `kpc_begin` does not allow it. */
u32 mark(void);
void *take(u64 bytes);
void release(u32 marked);

/* What hosts call. */
u32 kpc_begin(u32 most, u32 bytes);
Status kpc_segment(u32 codec, const u8 *body, u32 length, u32 rows, u32 columns, u32 channels, u32 implied, u8 *coded,
                   i8 *symbols);
Status kpc_project(const u8 *occupancy, u32 length, u32 plane, u8 *projected);
Status kpc_implied_map(const u8 *projected, u32 cell_rows, u32 cell_columns, u32 rows, u32 columns, u32 row_start,
                       u32 row_count, u8 *coded);
Status kpc_dequantise(const i8 *symbols, u32 texels, u32 channels, const float *step, const float *offset,
                      float *values);
Status kpc_motion(const u8 *body, u32 length, u8 *raw, u32 raw_length);
Status kpc_occupancy(const u8 *body, u32 length, u8 *raw, u32 raw_length);
Status kpc_weights(u32 is_hybrid, const u8 *body, u32 length, u8 *raw, u32 raw_length);
Status kpc_poses(const u8 *body, u32 length, u8 *raw, u32 raw_length);
u32 *kpc_arguments(void);
void kpc_call(void);

#endif
