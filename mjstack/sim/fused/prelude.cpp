// Beginning of every kernel here: the body of a Warp native function, done by warps of 32 threads,
// of which this is thread `lane` of warp `warp`. A warp needs no barrier. With LANES of 64 and more
// several warps do the work of one, and wait for each other. On Warp's CPU device a block has one
// thread, and the same text is plain C++.
//
// launch.py puts the constants before it: sizes of the model, and MuJoCo's numbers of types and flags.
// The members of `io` are arrays and numbers of MJWarp's model and data, by their names there.

#ifdef __CUDA_ARCH__
#define SHARED __shared__
#define SYNC() (T > 32 ? __syncthreads() : __syncwarp())
#define FROM(x, thread) __shfl_sync(~0u, x, thread)
#define READ(x) __ldg(&(x))  // of what no store of the kernel changes
constexpr int T = LANES;
#else
#define SHARED
#define SYNC()
#define FROM(x, thread) (x)
#define READ(x) (x)
constexpr int T = 1;
#endif
constexpr float TINY = 1e-15f;
