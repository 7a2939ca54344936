/* All of the library that a controller in plain C takes: on WebAssembly it is one instruction. */
static inline double sqrt(double x) { return __builtin_sqrt(x); }
