// What WebAssembly lacks: exceptions. What would throw, for want of memory, stops the module.

#if defined(__wasm__)

#include <cstddef>

extern "C" {
void *__cxa_allocate_exception(std::size_t) { __builtin_trap(); }
void __cxa_throw(void *, void *, void (*)(void *)) { __builtin_trap(); }
}

#endif
