/* Section 8.4: POSES. */

#include "kpc_core.h"

#define HEAD 17
#define LENS 20
#define CAMERA 68
#define WORD 7
#define FINEST (-126)
#define COARSEST 30

typedef union {
    double number;
    u64 bits;
} Double;

/* 8.4: the three numbers of 18 bits and the rest of an integer of 7 bytes. Return the rest. */
static u32 unpack(const u8 *at, i32 *numbers) {
    u64 word = load_u32(at) | (u64)load_u16(at + 4) << 32 | (u64)at[6] << 48;
    for (u32 k = 0; k < 3; k++) numbers[k] = (i32)(word >> 18 * k & 0x3FFFF);
    return (u32)(word >> 54);
}

static void store_f32(u8 *at, double value) {
    float rounded = (float)value;
    copy(at, &rounded, 4);
}

/* 8.4, "Rotation": the first three columns of a pose. Return whether there is such a rotation. */
static u32 decode_rotation(const i32 *component, u32 left_out, double axes[3][3]) {
    const i64 D = (i64)131071 * 131071;
    double q[4];
    i64 squares[4], square = 2 * D;
    for (u32 k = 0, next = 0; k < 4; k++) {
        if (k == left_out) continue;
        i64 stored = component[next++] - 131072;
        q[k] = (double)stored, squares[k] = stored * stored;
        square -= squares[k];
    }
    if (square < 0) return 0;
    squares[left_out] = square, q[left_out] = __builtin_sqrt((double)square);
    double w = q[0], x = q[1], y = q[2], z = q[3], one = (double)D;
    axes[0][0] = (double)(D - (squares[2] + squares[3])) / one;
    axes[1][1] = (double)(D - (squares[1] + squares[3])) / one;
    axes[2][2] = (double)(D - (squares[1] + squares[2])) / one;
    axes[0][1] = (x * y - w * z) / one, axes[0][2] = (x * z + w * y) / one;
    axes[1][0] = (x * y + w * z) / one, axes[1][2] = (y * z - w * x) / one;
    axes[2][0] = (x * z - w * y) / one, axes[2][1] = (y * z + w * x) / one;
    return 1;
}

/* 8.4: the pose of a camera, f32[12]. Return whether it is in range. */
static u32 decode_pose(const u8 *words, i32 exponent, const i32 *corner, u8 *pose) {
    i32 component[3], coordinate[3];
    double axes[3][3];
    Double unit = {.bits = (u64)(1023 + exponent) << 52}; /* 2^exponent */
    u32 left_out = unpack(words, component);
    if (left_out > 3 || unpack(words + WORD, coordinate) || !decode_rotation(component, left_out, axes)) return 0;
    for (u32 i = 0; i < 3; i++) {
        for (u32 j = 0; j < 3; j++) store_f32(pose + 16 * i + 4 * j, axes[i][j] + 0.0); /* 0, not -0 */
        store_f32(pose + 16 * i + 12, (double)((i64)corner[i] + coordinate[i]) * unit.number);
    }
    return 1;
}

/* 8.4: decode came to its content under RAW (6.6), `raw_length` bytes. */
EXPORT(kpc_poses) Status kpc_poses(const u8 *body, u32 length, u8 *raw, u32 raw_length) {
    if (length < HEAD) return POSES_CUT;
    u32 count = load_u16(body), lens_count = load_u16(body + 2), lenses = HEAD;
    i32 exponent = (i8)body[4], corner[3];
    if (count == 0 || count > CAMERA_LIMIT) return POSES_COUNT;
    if ((lens_count != 1 && lens_count != count) || exponent < FINEST || exponent > COARSEST) return POSES_HEAD;
    if (length != HEAD + LENS * lens_count + 2 * WORD * count) return POSES_LENGTH;
    if (raw_length != 2 + CAMERA * count) return CONTENT_LENGTH;
    for (u32 i = 0; i < 3; i++) corner[i] = (i32)load_u32(body + 5 + 4 * i);
    copy(raw, body, 2);
    for (u32 camera = 0; camera < count; camera++) {
        u8 *to = raw + 2 + CAMERA * camera;
        copy(to, body + lenses + (lens_count == 1 ? 0 : LENS * camera), LENS);
        const u8 *words = body + lenses + LENS * lens_count + 2 * WORD * camera;
        if (!decode_pose(words, exponent, corner, to + LENS)) return POSES_RANGE;
    }
    return OK;
}
